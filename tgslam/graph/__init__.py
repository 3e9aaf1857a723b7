"""The pose graph over keyframes, and the motions between keyframes far apart that correct it (section 3.4)."""
