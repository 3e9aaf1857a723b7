"""What the vector kernels share: 16 lanes are the 4x4 pixels of a chunk, 16 chunks make a 16x16 tile."""

import taichi as ti

TILE = 16  # px
LANES = 16
CHUNK = 4  # px
PER_ROW = TILE // CHUNK
CHUNKS = PER_ROW * PER_ROW
ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
SPREAD = 15  # a loop over tiles counts in steps of this, since Taichi hands a thread 512 iterations at a time; no power
# of two, or LLVM turns `tile * 16 + chunk` into an `or` and no longer sees that lanes are contiguous
T_MIN = 1e-4  # a chunk whose every pixel lets less than this through is finished

Lanes = ti.types.vector(LANES, ti.f32)
LaneBits = ti.types.vector(LANES, ti.i32)


@ti.func
def exp_neg(q):
    """exp(-q) for q >= 0 without a call, since a libm call stops vectorization (so does `floor` where SSE2 is all).

    2^whole by bit pattern, whole = t cut towards zero, and 2^fraction by a degree-4 minimax polynomial on (-1, 0]:
    relative error 2.6e-6.
    """
    t = ti.max(-q * 1.4426950408889634, -126.0)
    whole = ti.cast(t, ti.i32)
    f = t - ti.cast(whole, ti.f32)
    poly = 0.999997407 + f * (0.693030201 + f * (0.239341073 + f * (0.0530740658 + f * 0.00676708381)))
    return ti.bit_cast((whole + 127) << 23, ti.f32) * poly
