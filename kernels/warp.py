"""What the 32 threads of a warp do together. All of them must call these functions at the same time."""

import taichi as ti

WARP = 32  # threads
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


@ti.func
def merged(a, b, distance: ti.template(), lane):
    """a[lane] + a[lane ^ distance] in lanes where lane & distance is 0, the same of b in the others."""
    upper = (lane & distance) != 0
    return ti.select(upper, b, a) + shuffled_xor(ti.select(upper, a, b), distance)


@ti.func
def sums_of_4(a, b, c, d, lane):
    """In each lane the warp's sum of the (lane % 4)-th argument."""
    v = merged(merged(a, b, 1, lane), merged(c, d, 1, lane), 2, lane)
    for k in ti.static(range(2, 5)):
        v += shuffled_xor(v, 1 << k)
    return v


@ti.func
def sums_of_16(v0, v1, v2, v3, v4, v5, v6, v7, v8, v9, v10, v11, v12, v13, v14, v15, lane):
    """In each lane the warp's sum of the (lane % 16)-th argument: 16 shuffles, where 16 single sums take 80."""
    low = merged(
        merged(merged(v0, v1, 1, lane), merged(v2, v3, 1, lane), 2, lane),
        merged(merged(v4, v5, 1, lane), merged(v6, v7, 1, lane), 2, lane),
        4,
        lane,
    )
    high = merged(
        merged(merged(v8, v9, 1, lane), merged(v10, v11, 1, lane), 2, lane),
        merged(merged(v12, v13, 1, lane), merged(v14, v15, 1, lane), 2, lane),
        4,
        lane,
    )
    v = merged(low, high, 8, lane)
    return v + shuffled_xor(v, 16)
