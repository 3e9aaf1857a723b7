"""What the 32 threads of a warp do together. All of them must call these functions at the same time."""

import taichi as ti

WARP = 32
ALL = 0xFFFFFFFF  # mask of a whole warp


@ti.func
def shuffled_xor(v, distance: ti.template()):
    """The float that lane `lane ^ distance` holds (Taichi has this shuffle for integers only)."""
    return ti.bit_cast(ti.simt.warp.shfl_xor_i32(ti.u32(ALL), ti.bit_cast(v, ti.i32), distance), ti.f32)


@ti.func
def warp_sum(v):
    """Sum over the warp, in every lane, always added in the same order."""
    for k in ti.static(range(5)):
        v += shuffled_xor(v, 16 >> k)
    return v
