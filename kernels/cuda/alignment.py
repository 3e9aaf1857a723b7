"""Normal equations of RGB-D alignment under CUDA: a pixel a thread, sums by warp, then over the warps.

The sums are added in one order, so they repeat bit for bit as long as the grid stays the same.
"""

import taichi as ti

from tgslam.kernels.alignment import (
    GREY,
    GX,
    GXX,
    GXY,
    GY,
    GYY,
    LIVE_DEPTH,
    LIVE_GREY,
    LIVE_GX,
    LIVE_GY,
    LIVE_PIXELS,
    LIVE_STRENGTH,
    MODEL_DEPTH,
    SMALLEST,
    SUMS,
    add_residuals,
    in_model_image,
    reprojected,
)
from tgslam.kernels.cuda.block import BLOCK
from tgslam.kernels.simd import LANES
from tgslam.kernels.warp import WARP, warp_sum

_MAX_WARPS = 1024  # a thread takes several pixels of a larger image: summing over a warp costs as much as a pixel

nd = ti.types.ndarray


def warps(pixels):
    """Warps for an image of so many pixels: whole blocks."""
    return min(_MAX_WARPS, -(-pixels // BLOCK) * (BLOCK // WARP))


@ti.func
def bilinear(texture: ti.template(), channel: ti.template(), x, y, fx, fy):
    """A channel of the texture at (x + fx, y + fy)."""
    a, b = texture[y, x, channel], texture[y, x + 1, channel]
    c, d = texture[y + 1, x, channel], texture[y + 1, x + 1, channel]
    top = a + fx * (b - a)
    bottom = c + fx * (d - c)
    return top + fy * (bottom - top)


@ti.func
def add_pixel(
    settings: ti.template(),
    u,
    v,
    live: ti.template(),
    surface: ti.template(),
    texture: ti.template(),
    sums: ti.template(),
):
    """Add what a live pixel says to a row of sums, if it has depth."""
    block, lane = u // LANES, u % LANES
    depth = live[v, block, LIVE_DEPTH, lane]
    if depth > 0.0:
        sums[0, LIVE_PIXELS] += 1.0
        ray_x, ray_y, x, y, z = reprojected(settings, ti.cast(u, ti.f32), ti.cast(v, ti.f32), depth)
        um, vm, seen = in_model_image(settings, x, y, z, surface.shape[1], surface.shape[0])
        if seen > 0.0:
            un, vn = ti.cast(um + 0.5, ti.i32), ti.cast(vm + 0.5, ti.i32)
            uc, vc = ti.cast(um, ti.i32), ti.cast(vm, ti.i32)
            fx, fy = um - ti.cast(uc, ti.f32), vm - ti.cast(vc, ti.f32)
            add_residuals(
                settings, ray_x, ray_y,
                live[v, block, LIVE_GREY, lane], live[v, block, LIVE_GX, lane], live[v, block, LIVE_GY, lane],
                live[v, block, LIVE_STRENGTH, lane], x, y, z, seen,
                surface[vn, un, 0], surface[vn, un, 1], surface[vn, un, 2], surface[vn, un, MODEL_DEPTH],
                ti.cast(un, ti.f32), ti.cast(vn, ti.f32),
                bilinear(texture, GREY, uc, vc, fx, fy), bilinear(texture, GX, uc, vc, fx, fy),
                bilinear(texture, GY, uc, vc, fx, fy), bilinear(texture, GXX, uc, vc, fx, fy),
                bilinear(texture, GXY, uc, vc, fx, fy), bilinear(texture, GYY, uc, vc, fx, fy),
                sums, 0,
            )  # fmt: skip


@ti.kernel
def add_pixels(
    settings: nd(ti.f32, ndim=1),  # [SETTINGS]
    live: nd(ti.f32, ndim=4),  # [H, B, LIVE, 16]
    surface: nd(ti.f32, ndim=3),  # [H, W, SURFACE]
    texture: nd(ti.f32, ndim=3),  # [H, W, TEXTURE]
    by_warp: nd(ti.f32, ndim=2),  # [warps(H * W), SUMS] out
):
    """Sum the weighted normal equations of Eqs. 12, 13 over the live pixels that each warp takes."""
    ti.loop_config(block_dim=BLOCK)
    for thread in range(by_warp.shape[0] * WARP):
        height, width = surface.shape[0], surface.shape[1]
        sums = ti.Matrix([[0.0] * SUMS])
        pixel = thread
        while pixel < height * width and height >= SMALLEST and width >= SMALLEST:
            v = pixel // width
            add_pixel(settings, pixel - v * width, v, live, surface, texture, sums)
            pixel += by_warp.shape[0] * WARP
        for k in ti.static(range(SUMS)):
            total = warp_sum(sums[0, k])
            if thread % WARP == 0:
                by_warp[thread // WARP, k] = total


@ti.kernel
def add_warps(
    by_warp: nd(ti.f32, ndim=2),  # [warps, SUMS]
    totals: nd(ti.f32, ndim=1),  # [SUMS] out
):
    """Sum the warps' sums, each column by a warp."""
    ti.loop_config(block_dim=BLOCK)
    for thread in range(SUMS * WARP):
        column, row, total = thread // WARP, thread % WARP, 0.0
        while row < by_warp.shape[0]:
            total += by_warp[row, column]
            row += WARP
        total = warp_sum(total)
        if thread % WARP == 0:
            totals[column] = total
