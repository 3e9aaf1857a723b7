"""CUDA kernels, generated and executed without a GPU; see `harness`."""
