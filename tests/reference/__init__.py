"""Float64 NumPy twins of the kernels: written from the maths, dense and slow."""
