"""What the threads of a block do together. All of them must call these functions at the same time."""

import taichi as ti

from tgslam.kernels.warp import ALL, WARP

BLOCK = 256  # threads
WARPS = BLOCK // WARP
CHUNKS = BLOCK  # an array is cut into at most so many chunks, a block each, so that one block can add up all chunks


def chunk_length(count: int) -> int:
    """Entries of a chunk: a multiple of BLOCK, so that each warp of the chunk's block has the same number of them."""
    return max(1, -(-count // (CHUNKS * BLOCK))) * BLOCK


def chunks_of(count: int) -> int:
    """How many chunks `count` entries make; at least one."""
    return max(1, -(-count // chunk_length(count)))


@ti.func
def prefix_in_block(x, thread):
    """Sum of the integers x of the lower threads, and of all threads of the block."""
    of_warp = ti.simt.block.SharedArray((WARPS,), ti.i32)
    warp, lane = thread // WARP, thread % WARP
    inclusive = x
    for k in ti.static(range(5)):
        lower = ti.simt.warp.shfl_up_i32(ti.u32(ALL), inclusive, 1 << k)
        inclusive += ti.select(lane >= (1 << k), lower, 0)
    if lane == WARP - 1:
        of_warp[warp] = inclusive
    ti.simt.block.sync()
    before, total = inclusive - x, 0
    for w in ti.static(range(WARPS)):
        total += of_warp[w]
        before += ti.select(w < warp, of_warp[w], 0)
    ti.simt.block.sync()  # the next call may write now
    return before, total
