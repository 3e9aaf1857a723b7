"""Taichi kernels: pure functions over arrays and scalars. No I/O, no state, no configuration, no `ti.init`."""
