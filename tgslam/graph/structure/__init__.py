"""Structure closures (section 3.3): motions between keyframes, measured through the planes that both see."""
