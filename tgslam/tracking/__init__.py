"""Tracking: the pose of a frame against the map, by Gauss-Newton alignment or through the rasterizer's pose gradient."""
