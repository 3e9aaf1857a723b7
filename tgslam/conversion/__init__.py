"""Recordings written in the layouts of other programs and benchmarks."""
