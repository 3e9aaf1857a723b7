"""Tracking: a frame's pose against the map, by Gauss-Newton alignment or by the rasterizer's pose gradient."""
