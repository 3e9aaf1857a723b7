"""Mapping: seeding Gaussians from RGB-D keyframes, pruning, and refining the map with the window's poses."""
