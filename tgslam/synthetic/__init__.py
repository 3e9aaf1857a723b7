"""Built-in synthetic RGB-D scenes with exact depth, poses and planes, rendered frame by frame."""
