"""The pose graph over keyframes, and the motions between keyframes far apart that correct it (sections 3.3, 3.4)."""
