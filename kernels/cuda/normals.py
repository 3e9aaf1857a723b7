"""Plane fits of inverse depth under CUDA: a block of pixels a thread."""

import taichi as ti

from tgslam.kernels.cuda.block import BLOCK
from tgslam.kernels.normals import (
    FX,
    FY,
    MARGIN,
    NX,
    NY,
    NZ,
    SIGMA,
    STEEPEST,
    W0,
    WX,
    WY,
    alike,
    plane_fit,
)
from tgslam.kernels.simd import LANES

nd = ti.types.ndarray


@ti.kernel
def fit_planes(
    settings: nd(ti.f32, ndim=1),  # [SETTINGS]
    blocks: nd(ti.f32, ndim=3),  # [H // 2 + 2 MARGIN, B + 2, 16] 1/m
    radius: ti.i32,  # blocks, up to MARGIN
    least: ti.f32,  # like blocks that a fit needs
    fits: nd(ti.f32, ndim=4),  # [H // 2, B, FIT, 16] out
):
    """Fit a plane to the like neighbours of each block."""
    ti.loop_config(block_dim=BLOCK)
    for thread in range(fits.shape[0] * fits.shape[1] * LANES):
        columns = fits.shape[1] * LANES
        i = thread // columns
        j = thread - i * columns
        centre = blocks[i + MARGIN, j // LANES + 1, j % LANES]
        slope = centre * (2.0 * settings[STEEPEST] / ti.min(settings[FX], settings[FY]))
        n, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        sw, sxw, syw, sww = 0.0, 0.0, 0.0, 0.0
        for y in range(-radius, radius + 1):
            for x in range(-radius, radius + 1):
                column = j + x + LANES
                w = blocks[i + MARGIN + y, column // LANES, column % LANES]
                like = alike(w, centre, 4.0 * settings[SIGMA] + slope * ti.max(ti.abs(x), ti.abs(y)))
                d = like * (w - centre)
                n, sx, sy = n + like, sx + like * x, sy + like * y
                sxx, sxy, syy = sxx + like * (x * x), sxy + like * (x * y), syy + like * (y * y)
                sw, sxw, syw, sww = sw + d, sxw + d * x, syw + d * y, sww + d * d
        w0, wx, wy, nx, ny, nz = plane_fit(
            settings, 2.0 * j + 0.5, 2.0 * i + 0.5, centre, least, n, sx, sy, sxx, sxy, syy, sw, sxw, syw, sww
        )
        block, lane = j // LANES, j % LANES
        fits[i, block, W0, lane], fits[i, block, WX, lane], fits[i, block, WY, lane] = w0, wx, wy
        fits[i, block, NX, lane], fits[i, block, NY, lane], fits[i, block, NZ, lane] = nx, ny, nz
