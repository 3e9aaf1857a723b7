"""Depth images: how many measurements there are, and which no neighbour supports."""

import taichi as ti

from tgslam.kernels.image import SPLIT, segment

nd = ti.types.ndarray


@ti.kernel
def keep_supported(
    depth: nd(ti.f32, ndim=2),  # [H, W] m, 0 = none
    sigma_per_m2: ti.f32,
    tolerance_sigmas: ti.f32,
    slope: ti.f32,  # depth change a pixel that a steep surface may have, relative to depth
    min_neighbours: ti.i32,  # of 8
    kept: nd(ti.f32, ndim=2),  # [H, W] out
):
    """Keep the measurements with enough of their 8 neighbours at like depth."""
    height, width = depth.shape[0], depth.shape[1]
    for s in range(height * SPLIT):
        y, begin, end = segment(s, width)
        for x in range(begin, end):
            z = depth[y, x]
            tolerance = (tolerance_sigmas * sigma_per_m2 * z + slope) * z
            count = 0
            for dy in ti.static(range(-1, 2)):
                for dx in ti.static(range(-1, 2)):
                    if ti.static(dx != 0 or dy != 0):
                        yy, xx = ti.min(ti.max(y + dy, 0), height - 1), ti.min(ti.max(x + dx, 0), width - 1)
                        other = depth[yy, xx]
                        count += ti.select(other > 0.0 and ti.abs(other - z) < tolerance, 1, 0)
            kept[y, x] = ti.select(z > 0.0 and count >= min_neighbours, z, 0.0)


@ti.kernel
def count_measured(
    depth: nd(ti.f32, ndim=2),  # [H, W] m, 0 = none
    counts: nd(ti.i32, ndim=1),  # [H * SPLIT] out: of each segment of a row
):
    """Count the measurements."""
    for s in range(depth.shape[0] * SPLIT):
        y, begin, end = segment(s, depth.shape[1])
        count = 0
        for x in range(begin, end):
            count += ti.select(depth[y, x] > 0.0, 1, 0)
        counts[s] = count
