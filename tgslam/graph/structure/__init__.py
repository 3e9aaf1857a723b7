"""Structure closures (section 3.4): motions between keyframes, measured through the planes that both see."""
