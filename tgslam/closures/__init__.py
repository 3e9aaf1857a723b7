"""Structure closures (section 3.3): motions between keyframes far apart, measured through the planes that both see."""
