"""Prefix sums and sums over arrays on the device."""

import taichi as ti

from tgslam.kernels.cuda.block import BLOCK, prefix_in_block

nd = ti.types.ndarray


@ti.kernel
def sum_chunks(
    count: ti.i32,
    chunk: ti.i32,  # entries of a chunk
    chunks: ti.i32,
    values: nd(ti.i32, ndim=1),
    index: nd(ti.i32, ndim=1),  # [count]
    sums: nd(ti.i32, ndim=1),  # [chunks] out
):
    """Sums of values[index[k]] over each chunk of k."""
    ti.loop_config(block_dim=BLOCK)
    for i in range(chunks * BLOCK):
        first, thread = i // BLOCK * chunk, i % BLOCK
        own = 0
        for k in range(chunk // BLOCK):
            at = first + k * BLOCK + thread
            if at < count:
                own += values[index[at]]
        _, total = prefix_in_block(own, thread)
        if thread == 0:
            sums[i // BLOCK] = total


@ti.kernel
def prefix_sums(
    count: ti.i32,
    chunk: ti.i32,  # entries of a chunk
    chunks: ti.i32,  # at most CHUNKS
    values: nd(ti.i32, ndim=1),
    index: nd(ti.i32, ndim=1),  # [count]
    sums: nd(ti.i32, ndim=1),  # [chunks] of `sum_chunks`
    before: nd(ti.i32, ndim=1),  # [count + 1] out
):
    """before[k] = sum of values[index[j]] over j < k, up to k = count."""
    ti.loop_config(block_dim=BLOCK)
    for i in range(chunks * BLOCK):
        first, thread = i // BLOCK * chunk, i % BLOCK
        earlier = 0
        if thread < i // BLOCK:
            earlier = sums[thread]
        _, running = prefix_in_block(earlier, thread)
        for k in range(chunk // BLOCK):
            at = first + k * BLOCK + thread
            own = 0
            if at < count:
                own = values[index[at]]
            lower, total = prefix_in_block(own, thread)
            if at < count:
                before[at] = running + lower
            running += total
        if thread == 0 and i // BLOCK == chunks - 1:
            before[count] = running


@ti.kernel
def entry(values: nd(ti.i32, ndim=1), k: ti.i32) -> ti.i32:
    """values[k], read back by the host."""
    return values[k]
