"""Partial sums of blocks, added up on the CPU."""

import taichi as ti


@ti.kernel
def add_blocks(
    partial: ti.types.ndarray(dtype=ti.f32, ndim=2),  # [C, blocks]
    totals: ti.types.ndarray(dtype=ti.f32, ndim=1),  # [C] out, rounded once
):
    """Sums over the blocks, in their order."""
    for c in range(partial.shape[0]):
        total = ti.cast(0.0, ti.f64)
        for block in range(partial.shape[1]):
            total += ti.cast(partial[c, block], ti.f64)
        totals[c] = ti.cast(total, ti.f32)
