"""Places that look the same: features of images, which of them match, and the motion between two views."""
