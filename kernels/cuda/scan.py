"""Prefix sums and sums over arrays on the device."""

import taichi as ti

from tgslam.kernels.cuda.block import BLOCK, WARPS, prefix_in_block
from tgslam.kernels.warp import WARP, warp_sum

nd = ti.types.ndarray
vec6 = ti.types.vector(6, ti.f32)


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


@ti.kernel
def sum_rows(rows: nd(ti.f32, ndim=2), total: nd(ti.f32, ndim=1)) -> vec6:  # [n, 6], [6] out
    """Sum of all rows in a fixed order, read back by the host."""
    ti.loop_config(block_dim=BLOCK)
    for thread in range(BLOCK):
        of_warp = ti.simt.block.SharedArray((WARPS, 6), ti.f32)
        own = vec6(0.0)
        row = thread
        while row < rows.shape[0]:
            for c in ti.static(range(6)):
                own[c] += rows[row, c]
            row += BLOCK
        for c in ti.static(range(6)):
            in_warp = warp_sum(own[c])
            if thread % WARP == 0:
                of_warp[thread // WARP, c] = in_warp
        ti.simt.block.sync()
        if thread < 6:
            in_block = 0.0
            for w in ti.static(range(WARPS)):
                in_block += of_warp[w, thread]
            total[thread] = in_block
        ti.simt.block.sync()
    return vec6([total[c] for c in range(6)])
