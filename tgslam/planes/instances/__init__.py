"""Planar Gaussian Instances (section 3.3): how a view's planes are matched to them, and how they grow and end."""
