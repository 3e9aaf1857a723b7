"""Planes: seen in single views, and persistent in the world as Planar Gaussian Instances (sections 3.2, 3.3)."""
