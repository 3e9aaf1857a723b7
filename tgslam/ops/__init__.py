"""Kernels as functions on device arrays, checked at the boundary: `ops.x` wraps `kernels.x`, on either device."""
