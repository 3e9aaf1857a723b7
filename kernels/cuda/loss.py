"""Kernels of the objective under CUDA: a thread a pixel, planes of [H, W]; see kernels/objective.py for the terms.

The passes are those of kernels/loss.py, with each direction of the window in a kernel of its own. A warp leaves its own
partial sums, and one block for each sum adds them up in a fixed order: nothing is atomic, so results repeat.
"""

import taichi as ti

from tgslam.kernels.cuda.block import BLOCK, WARPS
from tgslam.kernels.objective import (
    BIAS,
    DEPTHS,
    GAIN,
    GEO,
    GRAD,
    INNER,
    L1,
    LUMA,
    MOMENTS,
    PIXELS,
    RADIUS,
    SSIM,
    TAPS,
    charbonnier_root,
    depth_slopes,
    flow_slopes,
    mixed,
    share,
    ssim_slopes,
)
from tgslam.kernels.warp import WARP, warp_sum

F1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
F3 = ti.types.ndarray(dtype=ti.f32, ndim=3)


def threads_for(height: int, width: int) -> int:
    """Threads for an image: whole blocks, so that every warp is whole."""
    return -(-height * width // BLOCK) * BLOCK


@ti.func
def is_inside(i, j, height, width):
    """Whether a pixel is not in the border of RADIUS px."""
    return (i >= RADIUS) and (i < height - RADIUS) and (j >= RADIUS) and (j < width - RADIUS)


@ti.func
def luma_at(colour: ti.template(), i, j):
    """Luminance of a pixel."""
    return LUMA[0] * colour[i, j, 0] + LUMA[1] * colour[i, j, 1] + LUMA[2] * colour[i, j, 2]


@ti.func
def valid_at(opacity, mask, min_opacity):
    """M_rgb, 0 where too little is rendered."""
    return ti.select(opacity >= min_opacity, mask, 0.0)


@ti.func
def leave_partial(v, column, p, partial: ti.template()):
    """Sum over the warp into partial[column, warp]."""
    total = warp_sum(v)
    if p % WARP == 0:
        partial[column, p // WARP] = total


@ti.kernel
def observe_luma(
    threads: ti.i32,
    colour: F3,  # [H, W, 3]
    gate: F2,  # [H, W] T of Eq. 11
    luma: F2,  # [H, W] out
    texture: F2,  # [H, W] out: 1 - T, the weight of the structure terms; 0 in the border
):
    """Luminance and texture of an observation."""
    height, width = luma.shape[0], luma.shape[1]
    ti.loop_config(block_dim=BLOCK)
    for p in range(threads):
        i = p // width
        j = p - i * width
        if i < height:
            luma[i, j] = luma_at(colour, i, j)
            texture[i, j] = ti.select(is_inside(i, j, height, width), 1.0 - gate[i, j], 0.0)


@ti.kernel
def observe_statistics(
    threads: ti.i32,
    column: F3,  # [MOMENTS, H, W] from `blur_columns` of y and y
    statistics: F3,  # [2, H, W] out, inside the border: mean and variance of y in the window
):
    """The observed side of SSIM."""
    height, width = statistics.shape[1], statistics.shape[2]
    ti.loop_config(block_dim=BLOCK)
    for p in range(threads):
        i = p // width
        j = p - i * width
        if is_inside(i, j, height, width):
            mean = blurred_row(column, 0, i, j)
            statistics[0, i, j] = mean
            statistics[1, i, j] = blurred_row(column, 1, i, j) - mean * mean


@ti.kernel
def mix(
    threads: ti.i32,
    colour: F3,  # [H, W, 3] rendered
    opacity: F2,  # [H, W]
    depth_gt: F2,  # [H, W] m
    mask: F2,  # [H, W] M_rgb in [0, 1]
    luma: F2,  # [H, W] observed y
    texture: F2,  # [H, W]
    gain: ti.f32,
    bias: ti.f32,
    min_opacity: ti.f32,  # rendered pixels below it have no colour to compare
    min_depth_opacity: ti.f32,  # nor depth
    x: F2,  # [H, W] out
    weight: F2,  # [H, W] out: M (1 - T), 0 in the border
    partial: F2,  # [TOTALS, warps] out: PIXELS, INNER, DEPTHS
):
    """What the structure terms compare, and the pixel counts."""
    height, width = luma.shape[0], luma.shape[1]
    ti.loop_config(block_dim=BLOCK)
    for p in range(threads):
        i = p // width
        j = p - i * width
        pixels, inner, depths = 0.0, 0.0, 0.0
        if i < height:
            pixels = valid_at(opacity[i, j], mask[i, j], min_opacity)
            inner = ti.select(is_inside(i, j, height, width), pixels, 0.0)
            depths = ti.select((depth_gt[i, j] > 0.0) and (opacity[i, j] > min_depth_opacity), 1.0, 0.0)
            x[i, j] = mixed(luma_at(colour, i, j), luma[i, j], pixels, gain, bias)
            weight[i, j] = pixels * texture[i, j]
        leave_partial(pixels, PIXELS, p, partial)
        leave_partial(inner, INNER, p, partial)
        leave_partial(depths, DEPTHS, p, partial)


@ti.kernel
def blur_columns(
    threads: ti.i32,
    x: F2,  # [H, W]
    y: F2,  # [H, W]
    column: F3,  # [MOMENTS, H, W] out, in the rows inside the border
):
    """Vertical window over x, x^2, x y."""
    height, width = x.shape[0], x.shape[1]
    ti.loop_config(block_dim=BLOCK)
    for p in range(threads):
        i = p // width
        j = p - i * width
        if i >= RADIUS and i < height - RADIUS:
            first, square, product = 0.0, 0.0, 0.0
            for k in ti.static(range(2 * RADIUS + 1)):
                value = x[i + k - RADIUS, j]
                tapped = TAPS[k] * value
                first += tapped
                square += tapped * value
                product += tapped * y[i + k - RADIUS, j]
            column[0, i, j] = first
            column[1, i, j] = square
            column[2, i, j] = product


@ti.func
def blurred_row(field: ti.template(), f: ti.template(), i, j):
    """Horizontal window at a pixel inside the border."""
    total = 0.0
    for k in ti.static(range(2 * RADIUS + 1)):
        total += TAPS[k] * field[f, i, j + k - RADIUS]
    return total


@ti.func
def difference(x: ti.template(), y: ti.template(), i, j):
    """x - y at a pixel."""
    return x[i, j] - y[i, j]


@ti.func
def sobel_of_difference(x: ti.template(), y: ti.template(), i, j):
    """Sobel responses of x - y over 8, at a pixel inside the border."""
    nw, ne = difference(x, y, i - 1, j - 1), difference(x, y, i - 1, j + 1)
    sw, se = difference(x, y, i + 1, j - 1), difference(x, y, i + 1, j + 1)
    west, east = difference(x, y, i, j - 1), difference(x, y, i, j + 1)
    north, south = difference(x, y, i - 1, j), difference(x, y, i + 1, j)
    gx = 0.125 * (ne - nw + se - sw + 2.0 * (east - west))
    gy = 0.125 * (sw - nw + se - ne + 2.0 * (south - north))
    return gx, gy


@ti.kernel
def structure(
    threads: ti.i32,
    x: F2,  # [H, W]
    y: F2,  # [H, W]
    column: F3,  # [MOMENTS, H, W] from `blur_columns`
    statistics: F3,  # [2, H, W] mean and variance of y
    weight: F2,  # [H, W]
    epsilon: ti.f32,  # Charbonnier, intensity per px
    slope: F3,  # [SLOPES, H, W] out, inside the border (0 there)
    partial: F2,  # [TOTALS, warps] out: SSIM, GRAD
):
    """SSIM in the 11x11 Gaussian window, and Charbonnier on the length of the Sobel gradient (over 8) of x - y."""
    height, width = x.shape[0], x.shape[1]
    ti.loop_config(block_dim=BLOCK)
    for p in range(threads):
        i = p // width
        j = p - i * width
        ssim, grad = 0.0, 0.0
        if is_inside(i, j, height, width):
            w = weight[i, j]
            ssim, slope[0, i, j], slope[1, i, j], slope[2, i, j] = ssim_slopes(
                blurred_row(column, 0, i, j),
                blurred_row(column, 1, i, j),
                blurred_row(column, 2, i, j),
                statistics[0, i, j],
                statistics[1, i, j],
                w,
            )
            gx, gy = sobel_of_difference(x, y, i, j)
            grad, slope[3, i, j], slope[4, i, j] = flow_slopes(gx, gy, w, epsilon)
        leave_partial(ssim, SSIM, p, partial)
        leave_partial(grad, GRAD, p, partial)


@ti.func
def slope_at(slope: ti.template(), f: ti.template(), i, j, width):
    """A derivative in row i; 0 outside the image."""
    return ti.select((j >= 0) and (j < width), slope[f, i, ti.min(ti.max(j, 0), width - 1)], 0.0)


@ti.kernel
def adjoint_rows(
    threads: ti.i32,
    slope: F3,  # [SLOPES, H, W] from `structure`
    field: F3,  # [SLOPES, H, W] out, in the rows inside the border (0 there)
):
    """Horizontal step of the adjoints of the window, which is symmetric, and of Sobel."""
    height, width = field.shape[1], field.shape[2]
    ti.loop_config(block_dim=BLOCK)
    for p in range(threads):
        i = p // width
        j = p - i * width
        if i >= RADIUS and i < height - RADIUS:
            for f in ti.static(range(MOMENTS)):
                total = 0.0
                for k in ti.static(range(2 * RADIUS + 1)):
                    total += TAPS[k] * slope_at(slope, f, i, j + k - RADIUS, width)
                field[f, i, j] = total
            field[3, i, j] = slope_at(slope, 3, i, j - 1, width) - slope_at(slope, 3, i, j + 1, width)
            field[4, i, j] = (
                slope_at(slope, 4, i, j - 1, width)
                + 2.0 * slope_at(slope, 4, i, j, width)
                + slope_at(slope, 4, i, j + 1, width)
            )


@ti.kernel
def add_partials(
    warps: ti.i32,
    partial: F2,  # [TOTALS, warps]
    first: ti.i32,
    end: ti.i32,
    totals: F1,  # [TOTALS] out: sums of the rows first <= c < end
):
    """Sums over the warps, a block for each."""
    ti.loop_config(block_dim=BLOCK)
    for p in range((end - first) * BLOCK):
        of_warp = ti.simt.block.SharedArray((WARPS,), ti.f32)
        column, thread = first + p // BLOCK, p % BLOCK
        own = 0.0
        at = thread
        while at < warps:
            own += partial[column, at]
            at += BLOCK
        total = warp_sum(own)
        if thread % WARP == 0:
            of_warp[thread // WARP] = total
        ti.simt.block.sync()
        if thread == 0:
            for w in ti.static(range(1, WARPS)):
                total += of_warp[w]
            totals[column] = total
        ti.simt.block.sync()  # the block's next sum may write now


@ti.kernel
def gradient(
    threads: ti.i32,
    colour: F3,  # [H, W, 3] rendered
    depth: F2,  # [H, W] m, accumulated: sum of weight times depth
    opacity: F2,  # [H, W]
    colour_gt: F3,  # [H, W, 3]
    depth_gt: F2,  # [H, W] m, 0 = none
    mask: F2,  # [H, W]
    gate: F2,  # [H, W] T
    x: F2,  # [H, W] from mix
    y: F2,  # [H, W]
    field: F3,  # [SLOPES, H, W] from `adjoint_rows`
    totals: F1,  # [TOTALS] of which the counts are read
    gain: ti.f32,
    bias: ti.f32,
    min_opacity: ti.f32,
    min_depth_opacity: ti.f32,
    epsilon_colour: ti.f32,  # Charbonnier, intensity
    epsilon_depth: ti.f32,  # Charbonnier, in standard deviations
    boost: ti.f32,  # depth residuals count 1 + boost T
    sigma_per_m2: ti.f32,  # 1/m
    weight_l1: ti.f32,
    weight_grad: ti.f32,
    weight_ssim: ti.f32,
    weight_geo: ti.f32,
    g_colour: F3,  # [H, W, 3] out
    g_depth: F2,  # [H, W] out
    g_opacity: F2,  # [H, W] out
    w_colour: F2,  # [H, W] out: curvature of the intensity term by a rendered channel, the same for all three
    w_depth: F2,  # [H, W] out: curvature by depth, 1/m^2
    partial: F2,  # [TOTALS, warps] out: L1, GAIN, BIAS, GEO
):
    """Derivatives of all terms by the rendered images, gain and bias; see kernels/loss.py for the curvatures."""
    height, width = x.shape[0], x.shape[1]
    ti.loop_config(block_dim=BLOCK)
    for p in range(threads):
        i = p // width
        j = p - i * width
        l1, by_gain, by_bias, geo = 0.0, 0.0, 0.0, 0.0
        if i < height:
            per_l1 = share(weight_l1, 3.0 * totals[PIXELS])
            valid = valid_at(opacity[i, j], mask[i, j], min_opacity)
            by_luma = valid * luma_slope(
                x, y, field, i, j, share(weight_ssim, totals[INNER]), share(weight_grad, totals[INNER])
            )
            squares = 0.0
            for c in ti.static(range(3)):
                r = gain * colour[i, j, c] + bias - colour_gt[i, j, c]
                squares += r * r
                root = charbonnier_root(r * r, epsilon_colour)
                g = per_l1 * valid * r / root + LUMA[c] * by_luma
                l1 += valid * (root - epsilon_colour)
                by_gain += g * colour[i, j, c]
                by_bias += g
                g_colour[i, j, c] = gain * g
            w_colour[i, j] = per_l1 * gain * gain * valid / charbonnier_root(squares / 3.0, epsilon_colour)

            by_depth, by_opacity, curvature = 0.0, 0.0, 0.0
            if depth_gt[i, j] > 0.0 and opacity[i, j] > min_depth_opacity:
                per_geo = share(weight_geo, totals[DEPTHS])
                geo, by_depth, by_opacity, curvature = depth_slopes(
                    depth[i, j], opacity[i, j], depth_gt[i, j], 1.0 + boost * gate[i, j], sigma_per_m2, epsilon_depth
                )
                by_depth *= per_geo
                by_opacity *= per_geo
                curvature *= per_geo
            g_depth[i, j] = by_depth
            g_opacity[i, j] = by_opacity
            w_depth[i, j] = curvature
        leave_partial(l1, L1, p, partial)
        leave_partial(by_gain, GAIN, p, partial)
        leave_partial(by_bias, BIAS, p, partial)
        leave_partial(geo, GEO, p, partial)


@ti.func
def luma_slope(x: ti.template(), y: ti.template(), field: ti.template(), i, j, per_ssim, per_grad):
    """Derivative of both structure terms by x: the adjoint's vertical step. Rows that are clamped are border, so 0."""
    last = x.shape[0] - 1
    by_mean, by_square, by_product = 0.0, 0.0, 0.0
    for k in ti.static(range(2 * RADIUS + 1)):
        row = ti.min(ti.max(i + k - RADIUS, 0), last)
        by_mean += TAPS[k] * field[0, row, j]
        by_square += TAPS[k] * field[1, row, j]
        by_product += TAPS[k] * field[2, row, j]
    up, down = ti.max(i - 1, 0), ti.min(i + 1, last)
    smooth = field[3, up, j] + 2.0 * field[3, i, j] + field[3, down, j]
    step = field[4, up, j] - field[4, down, j]
    windowed = by_mean + 2.0 * x[i, j] * by_square + y[i, j] * by_product
    return per_ssim * windowed + 0.125 * per_grad * (smooth + step)
