"""Kernels of the adaptive RGB-depth objective, Eqs. 12 and 13: value and gradient. CPU form; see objective.py.

An image of one channel is [H, B] vectors of 16 pixels of a row, B = ceil(W / 16); an RGB image is [H, 3 B] vectors of
interleaved channels, so that memory is what [H, W] and [H, W, 3] are where W is a multiple of 16. Beyond W, the mask,
texture and depth are 0.

The passes over one image, each row by row; a row has one writer, and leaves its own partial sums:
  mix             rendered luminance x, weights of the structure terms, pixel counts
  structure       SSIM and gradient term with their derivatives, up to the last, vertical step of the adjoints
  add_partials    sums over the rows
  gradient        the vertical step, intensity and depth terms, chain rule to the rendered images, gain and bias
"""

import taichi as ti

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
from tgslam.kernels.simd import LANES, Lanes, lane_sum, lanes_kernel

F1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
L2 = ti.types.ndarray(dtype=Lanes, ndim=2)
L3 = ti.types.ndarray(dtype=Lanes, ndim=3)

ROW_SPREAD = 64  # a loop over rows counts in steps of this: Taichi hands a thread 512 iterations at a time, so 8 rows
LANE = tuple(float(k) for k in range(LANES))
# Where lanes come from: which of three vectors, and which of its lanes
SHIFTED = {
    offset: tuple(divmod(k + offset + LANES, LANES) for k in range(LANES)) for offset in range(-LANES, LANES + 1)
}
CHANNEL = tuple(tuple(divmod(3 * k + which, LANES) for k in range(LANES)) for which in range(3))
LUMA_PARTS = tuple(tuple(LUMA[(LANES * part + k) % 3] for k in range(LANES)) for part in range(3))


@ti.func
def channel(a, b, c, which: ti.template()):
    """One channel of 16 pixels that lie interleaved in three vectors."""
    return Lanes([(a, b, c)[source][k] for source, k in ti.static(CHANNEL[which])])


@ti.func
def channel_sum(a, b, c):
    """Sum over the channels of 16 pixels that lie interleaved in three vectors."""
    return channel(a, b, c, 0) + channel(a, b, c, 1) + channel(a, b, c, 2)


@ti.func
def for_channels(v, part: ti.template()):
    """Values of 16 pixels, repeated for the three channels: the part-th of the three interleaved vectors."""
    return Lanes([v[(LANES * part + k) // 3] for k in ti.static(range(LANES))])


@ti.func
def luma_at(colour: ti.template(), i, b):
    """Luminance of block b of row i."""
    return channel_sum(
        colour[i, 3 * b] * Lanes(LUMA_PARTS[0]),
        colour[i, 3 * b + 1] * Lanes(LUMA_PARTS[1]),
        colour[i, 3 * b + 2] * Lanes(LUMA_PARTS[2]),
    )


@ti.func
def inside_columns(b, width):
    """1 for pixels of block b that are not in the border of RADIUS px, 0 for the rest."""
    column = Lanes(LANE) + ti.cast(b * LANES, ti.f32)
    from_left = ti.select(column > Lanes(RADIUS - 0.5), Lanes(1.0), Lanes(0.0))
    return from_left * ti.select(column < Lanes(ti.cast(width - RADIUS, ti.f32) - 0.5), Lanes(1.0), Lanes(0.0))


@ti.func
def is_inside_row(i, height):
    """Whether row i is not in the border."""
    return i >= RADIUS and i < height - RADIUS


@ti.func
def shifted(left, centre, right, offset: ti.template()):
    """The 16 pixels `offset` to the right of `centre`, from it and its neighbours; |offset| <= 16."""
    blocks = ti.static((left, centre, right))
    return Lanes([blocks[source][k] for source, k in SHIFTED[offset]])


@ti.func
def blurred_row(field: ti.template(), i, b, f):
    """Horizontal window at block b of field [H, 1 + B + 1, F], whose outer blocks are 0."""
    left, centre, right = field[i, b, f], field[i, b + 1, f], field[i, b + 2, f]
    total = TAPS[RADIUS] * centre
    for k in ti.static(range(1, RADIUS + 1)):
        total += TAPS[RADIUS + k] * (shifted(left, centre, right, -k) + shifted(left, centre, right, k))
    return total


@lanes_kernel
def observe_luma(
    width: ti.i32,
    colour: L2,  # [H, 3 B]
    gate: L2,  # [H, B] T of Eq. 11
    luma: L2,  # [H, B] out
    texture: L2,  # [H, B] out: 1 - T, the weight of the structure terms; 0 in the border and beyond W
):
    """Luminance and texture of an observation."""
    height = luma.shape[0]
    for spread in range(height * ROW_SPREAD):
        i = spread // ROW_SPREAD
        if spread - i * ROW_SPREAD == 0:
            inside = ti.select(is_inside_row(i, height), 1.0, 0.0)
            for b in range(luma.shape[1]):
                luma[i, b] = luma_at(colour, i, b)
                texture[i, b] = inside * inside_columns(b, width) * (1.0 - gate[i, b])


@lanes_kernel
def observe_statistics(
    luma: L2,  # [H, B]
    column: L3,  # [H, 1 + B + 1, MOMENTS] scratch, outer blocks 0
    statistics: L3,  # [H, B, 2] out, inside the border: mean and variance of y in the window
):
    """The observed side of SSIM."""
    height = luma.shape[0]
    for spread in range(height * ROW_SPREAD):
        i = spread // ROW_SPREAD
        if spread - i * ROW_SPREAD == 0 and is_inside_row(i, height):
            for b in range(luma.shape[1]):
                y = luma[i, b]
                first, square = TAPS[RADIUS] * y, TAPS[RADIUS] * y * y
                for k in ti.static(range(1, RADIUS + 1)):
                    up, down = luma[i - k, b], luma[i + k, b]
                    first += TAPS[RADIUS + k] * (up + down)
                    square += TAPS[RADIUS + k] * (up * up + down * down)
                column[i, b + 1, 0] = first
                column[i, b + 1, 1] = square
            for b in range(luma.shape[1]):
                mean = blurred_row(column, i, b, 0)
                statistics[i, b, 0] = mean
                statistics[i, b, 1] = blurred_row(column, i, b, 1) - mean * mean


@lanes_kernel
def mix(
    width: ti.i32,
    colour: L2,  # [H, 3 B] rendered
    opacity: L2,  # [H, B]
    depth_gt: L2,  # [H, B] m
    mask: L2,  # [H, B] M_rgb in [0, 1]
    luma: L2,  # [H, B] observed y
    texture: L2,  # [H, B]
    gain: ti.f32,
    bias: ti.f32,
    min_opacity: ti.f32,  # rendered pixels below it have no colour to compare
    min_depth_opacity: ti.f32,  # nor depth
    x: L2,  # [H, B] out
    weight: L2,  # [H, B] out: M (1 - T), 0 in the border
    partial: F2,  # [H, TOTALS] out: PIXELS, INNER, DEPTHS
):
    """What the structure terms compare, and the pixel counts."""
    height = luma.shape[0]
    for spread in range(height * ROW_SPREAD):
        i = spread // ROW_SPREAD
        if spread - i * ROW_SPREAD == 0:
            pixels, inner, depths = Lanes(0.0), Lanes(0.0), Lanes(0.0)
            for b in range(luma.shape[1]):
                rendered = opacity[i, b]
                valid = ti.select(rendered >= Lanes(min_opacity), mask[i, b], Lanes(0.0))
                x[i, b] = mixed(luma_at(colour, i, b), luma[i, b], valid, gain, bias)
                weight[i, b] = valid * texture[i, b]
                pixels += valid
                inner += valid * inside_columns(b, width)
                depths += measured(depth_gt[i, b], rendered, min_depth_opacity)
            partial[i, PIXELS] = lane_sum(pixels)
            partial[i, INNER] = ti.select(is_inside_row(i, height), lane_sum(inner), 0.0)
            partial[i, DEPTHS] = lane_sum(depths)


@ti.func
def measured(depth_gt, opacity, min_depth_opacity):
    """1 where rendered and measured depth can be compared, 0 elsewhere."""
    has_depth = ti.select(depth_gt > Lanes(0.0), Lanes(1.0), Lanes(0.0))
    return has_depth * ti.select(opacity > Lanes(min_depth_opacity), Lanes(1.0), Lanes(0.0))


@lanes_kernel
def structure(
    x: L2,  # [H, B]
    y: L2,  # [H, B]
    statistics: L3,  # [H, B, 2] mean and variance of y
    weight: L2,  # [H, B]
    epsilon: ti.f32,  # Charbonnier, intensity per px
    column: L3,  # [H, 1 + B + 1, MOMENTS] scratch, outer blocks 0
    slope: L3,  # [H, 1 + B + 1, SLOPES] scratch, outer blocks 0
    field: L3,  # [H, B, SLOPES] out, inside the border (0 there): derivatives, adjoint but for its vertical step
    partial: F2,  # [H, TOTALS] out: SSIM, GRAD; 0 in the border
):
    """SSIM in the 11x11 Gaussian window, and Charbonnier on the length of the Sobel gradient (over 8) of x - y."""
    height, blocks = x.shape[0], x.shape[1]
    for spread in range(height * ROW_SPREAD):
        i = spread // ROW_SPREAD
        if spread - i * ROW_SPREAD == 0 and is_inside_row(i, height):
            for b in range(blocks):
                blur_moments(x, y, i, b, column)
            ssim, grad = Lanes(0.0), Lanes(0.0)
            for b in range(blocks):
                mx, xx, xy = blurred_row(column, i, b, 0), blurred_row(column, i, b, 1), blurred_row(column, i, b, 2)
                penalty, by_mean, by_square, by_product = ssim_slopes(
                    mx, xx, xy, statistics[i, b, 0], statistics[i, b, 1], weight[i, b]
                )
                ssim += penalty
                slope[i, b + 1, 0] = by_mean
                slope[i, b + 1, 1] = by_square
                slope[i, b + 1, 2] = by_product
                gx, gy = sobel_of_difference(x, y, i, b)
                length, by_gx, by_gy = flow_slopes(gx, gy, weight[i, b], epsilon)
                grad += length
                slope[i, b + 1, 3] = by_gx
                slope[i, b + 1, 4] = by_gy
            for b in range(blocks):
                for f in range(MOMENTS):
                    field[i, b, f] = blurred_row(slope, i, b, f)  # the window is symmetric: its own adjoint
                left, centre, right = slope[i, b, 3], slope[i, b + 1, 3], slope[i, b + 2, 3]
                field[i, b, 3] = shifted(left, centre, right, -1) - shifted(left, centre, right, 1)
                left, centre, right = slope[i, b, 4], slope[i, b + 1, 4], slope[i, b + 2, 4]
                field[i, b, 4] = shifted(left, centre, right, -1) + 2.0 * centre + shifted(left, centre, right, 1)
            partial[i, SSIM] = lane_sum(ssim)
            partial[i, GRAD] = lane_sum(grad)


@ti.func
def blur_moments(x: ti.template(), y: ti.template(), i, b, column: ti.template()):
    """Vertical window over x, x^2, x y."""
    p = x[i, b]
    first = TAPS[RADIUS] * p
    square, product = first * p, first * y[i, b]
    for k in ti.static(range(1, RADIUS + 1)):
        up, down = x[i - k, b], x[i + k, b]
        first += TAPS[RADIUS + k] * (up + down)
        square += TAPS[RADIUS + k] * (up * up + down * down)
        product += TAPS[RADIUS + k] * (up * y[i - k, b] + down * y[i + k, b])
    column[i, b + 1, 0] = first
    column[i, b + 1, 1] = square
    column[i, b + 1, 2] = product


@ti.func
def sobel_of_difference(x: ti.template(), y: ti.template(), i, b):
    """Sobel responses of x - y over 8, inside the border."""
    before, after = ti.max(b - 1, 0), ti.min(b + 1, x.shape[1] - 1)  # beyond the image there is no weight
    smooth_l, step_l = sobel_columns(x, y, i, before)
    smooth_c, step_c = sobel_columns(x, y, i, b)
    smooth_r, step_r = sobel_columns(x, y, i, after)
    gx = shifted(smooth_l, smooth_c, smooth_r, 1) - shifted(smooth_l, smooth_c, smooth_r, -1)
    gy = shifted(step_l, step_c, step_r, 1) + 2.0 * step_c + shifted(step_l, step_c, step_r, -1)
    return gx, gy


@ti.func
def sobel_columns(x: ti.template(), y: ti.template(), i, b):
    """Vertical half of Sobel over x - y: smoothed, and the difference, both over 8."""
    up, row, down = x[i - 1, b] - y[i - 1, b], x[i, b] - y[i, b], x[i + 1, b] - y[i + 1, b]
    return 0.125 * (up + down + 2.0 * row), 0.125 * (down - up)


@ti.kernel
def add_partials(
    partial: F2,  # [R, TOTALS]
    first: ti.i32,
    end: ti.i32,
    totals: F1,  # [TOTALS] out: sums of the columns first <= c < end, rounded once
):
    """Sums over the rows, in their order."""
    for c in range(first, end):
        total = ti.cast(0.0, ti.f64)
        for row in range(partial.shape[0]):
            total += ti.cast(partial[row, c], ti.f64)
        totals[c] = ti.cast(total, ti.f32)


@lanes_kernel
def gradient(
    colour: L2,  # [H, 3 B] rendered
    depth: L2,  # [H, B] m, accumulated: sum of weight times depth
    opacity: L2,  # [H, B]
    colour_gt: L2,  # [H, 3 B]
    depth_gt: L2,  # [H, B] m, 0 = none
    mask: L2,  # [H, B]
    gate: L2,  # [H, B] T
    x: L2,  # [H, B] from mix
    y: L2,  # [H, B]
    field: L3,  # [H, B, SLOPES] from structure, 0 in the border
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
    g_colour: L2,  # [H, 3 B] out
    g_depth: L2,  # [H, B] out
    g_opacity: L2,  # [H, B] out
    w_colour: L2,  # [H, B] out: curvature of the intensity term by a rendered channel, the same for all three
    w_depth: L2,  # [H, B] out: curvature by depth, 1/m^2
    partial: F2,  # [H, TOTALS] out: L1, GAIN, BIAS, GEO
):
    """Derivatives of all terms by the rendered images, gain and bias.

    The curvatures are those of reweighted least squares; that of colour has one weight a pixel, from the mean square of
    its residuals.
    """
    for spread in range(x.shape[0] * ROW_SPREAD):
        i = spread // ROW_SPREAD
        if spread - i * ROW_SPREAD == 0:
            per_l1 = share(weight_l1, 3.0 * totals[PIXELS])
            per_grad, per_ssim = share(weight_grad, totals[INNER]), share(weight_ssim, totals[INNER])
            per_geo = share(weight_geo, totals[DEPTHS])
            l1, by_gain, by_bias, geo = Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0)
            for b in range(x.shape[1]):
                by_luma = luma_slope(x, y, field, i, b, per_ssim, per_grad)
                valid = ti.select(opacity[i, b] >= Lanes(min_opacity), mask[i, b], Lanes(0.0))
                r0 = gain * colour[i, 3 * b] + bias - colour_gt[i, 3 * b]
                r1 = gain * colour[i, 3 * b + 1] + bias - colour_gt[i, 3 * b + 1]
                r2 = gain * colour[i, 3 * b + 2] + bias - colour_gt[i, 3 * b + 2]
                by_luma *= valid
                for part in ti.static(range(3)):
                    r = ti.static((r0, r1, r2))[part]
                    m = for_channels(valid, part)
                    root = charbonnier_root(r * r, epsilon_colour)
                    g = per_l1 * m * r / root + for_channels(by_luma, part) * Lanes(LUMA_PARTS[part])
                    l1 += m * (root - epsilon_colour)
                    by_gain += g * colour[i, 3 * b + part]
                    by_bias += g
                    g_colour[i, 3 * b + part] = gain * g
                square = channel_sum(r0 * r0, r1 * r1, r2 * r2) * (1.0 / 3.0)
                w_colour[i, b] = per_l1 * gain * gain * valid / charbonnier_root(square, epsilon_colour)

                has_depth = measured(depth_gt[i, b], opacity[i, b], min_depth_opacity)
                penalty, by_depth, by_opacity, curvature = depth_slopes(
                    depth[i, b],
                    ti.select(has_depth > Lanes(0.5), opacity[i, b], Lanes(1.0)),
                    ti.select(has_depth > Lanes(0.5), depth_gt[i, b], Lanes(1.0)),
                    has_depth * (1.0 + boost * gate[i, b]),
                    sigma_per_m2,
                    epsilon_depth,
                )
                geo += penalty
                g_depth[i, b] = per_geo * by_depth
                g_opacity[i, b] = per_geo * by_opacity
                w_depth[i, b] = per_geo * curvature
            partial[i, L1] = lane_sum(l1)
            partial[i, GAIN] = lane_sum(by_gain)
            partial[i, BIAS] = lane_sum(by_bias)
            partial[i, GEO] = lane_sum(geo)


@ti.func
def luma_slope(x: ti.template(), y: ti.template(), field: ti.template(), i, b, per_ssim, per_grad):
    """Derivative of both structure terms by x: the adjoint's vertical step. Rows that are clamped are border, so 0."""
    height = x.shape[0]
    by_mean, by_square, by_product = (
        TAPS[RADIUS] * field[i, b, 0],
        TAPS[RADIUS] * field[i, b, 1],
        TAPS[RADIUS] * field[i, b, 2],
    )
    for k in ti.static(range(1, RADIUS + 1)):
        above, below = ti.max(i - k, 0), ti.min(i + k, height - 1)
        by_mean += TAPS[RADIUS + k] * (field[above, b, 0] + field[below, b, 0])
        by_square += TAPS[RADIUS + k] * (field[above, b, 1] + field[below, b, 1])
        by_product += TAPS[RADIUS + k] * (field[above, b, 2] + field[below, b, 2])
    up, down = ti.max(i - 1, 0), ti.min(i + 1, height - 1)
    smooth = field[up, b, 3] + 2.0 * field[i, b, 3] + field[down, b, 3]
    step = field[up, b, 4] - field[down, b, 4]
    windowed = by_mean + 2.0 * x[i, b] * by_square + y[i, b] * by_product
    return per_ssim * windowed + 0.125 * per_grad * (smooth + step)
