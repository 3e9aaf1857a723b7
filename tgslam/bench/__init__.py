"""Benchmarks: how fast the rasterizer, tracking, mapping and whole runs are here, as ratios where they can be."""
