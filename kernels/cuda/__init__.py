"""Kernels that only CUDA can run: warps, shared memory, barriers. A block has 256 threads, a warp 32."""
