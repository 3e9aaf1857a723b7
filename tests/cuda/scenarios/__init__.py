"""What the tests run on the CPU device and under the CUDA check: a module for each family of kernels."""
