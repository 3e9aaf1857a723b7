"""Kernels of the adaptive RGB-depth objective, Eqs. 12 and 13: value and gradient. CPU form.

Luminance work runs on 16 pixels of a row at once: a `Lanes` image is [H, ceil(W / 16)] vectors, zero weight beyond W.
Each row is cut into SPLIT parallel segments (see kernels/image.py); sums leave as one partial a segment.

The passes over one image, in order:
  mix             rendered luminance x, structure weights, pixel counts
  blur_moments    vertical window over x, x^2, x y
  ssim            horizontal window, SSIM value, its derivative by the three moments
  blur_rows       horizontal window over the derivatives (the window is symmetric: its own adjoint)
  sobel_flow      derivative of the gradient term by the two Sobel responses
  luma_gradient   vertical window and Sobel adjoint: derivative by x
  colour_gradient intensity term, chain rule to colour, gain and bias
  depth_gradient  Eq. 13
"""

import math

import taichi as ti

from tgslam.kernels.image import F2, F3, SPLIT, segment
from tgslam.kernels.simd import LANES, Lanes

RADIUS = 5  # px: the usual 11x11 SSIM window, and the border that the gradient and SSIM terms leave out
SIGMA = 1.5  # px
C1, C2 = 0.01**2, 0.03**2  # the usual SSIM constants for intensities in [0, 1]
LUMA = (0.299, 0.587, 0.114)
_BELL = [math.exp(-0.5 * (k / SIGMA) ** 2) for k in range(-RADIUS, RADIUS + 1)]
TAPS = tuple(tap / sum(_BELL) for tap in _BELL)

L2 = ti.types.ndarray(dtype=Lanes, ndim=2)
L3 = ti.types.ndarray(dtype=Lanes, ndim=3)


@ti.kernel
def pack_luminance(
    colour: F3,  # [H, W, 3] RGB
    grey: L2,  # [H, B] out, 0 beyond W
):
    """Luminance as lanes."""
    width = colour.shape[1]
    for s in range(grey.shape[0] * SPLIT):
        i, begin, end = segment(s, grey.shape[1])
        for b in range(begin, end):
            y = Lanes(0.0)
            for k in ti.static(range(LANES)):
                j = ti.min(b * LANES + k, width - 1)
                value = LUMA[0] * colour[i, j, 0] + LUMA[1] * colour[i, j, 1] + LUMA[2] * colour[i, j, 2]
                y[k] = ti.select(b * LANES + k < width, value, 0.0)
            grey[i, b] = y


@ti.kernel
def pack_texture(
    gate: F2,  # [H, W] T of Eq. 11
    texture: L2,  # [H, B] out: 1 - T, 0 in the border of RADIUS px and beyond W
):
    """Weight of the gradient and SSIM terms."""
    height, width = gate.shape[0], gate.shape[1]
    for s in range(height * SPLIT):
        i, begin, end = segment(s, texture.shape[1])
        for b in range(begin, end):
            g = Lanes(0.0)
            for k in ti.static(range(LANES)):
                j = b * LANES + k
                inside = (j >= RADIUS) and (j < width - RADIUS) and (i >= RADIUS) and (i < height - RADIUS)
                g[k] = ti.select(inside, 1.0 - gate[i, ti.min(j, width - 1)], 0.0)
            texture[i, b] = g


@ti.func
def shifted(left, centre, right, offset: ti.template()):
    """The 16 pixels `offset` to the right of `centre`, from it and its neighbours; |offset| <= 16."""
    out = Lanes(0.0)
    for k in ti.static(range(LANES)):
        if ti.static(k + offset < 0):
            out[k] = left[k + offset + LANES]
        elif ti.static(k + offset >= LANES):
            out[k] = right[k + offset - LANES]
        else:
            out[k] = centre[k + offset]
    return out


@ti.func
def blurred_row(field: ti.template(), i, b, f):
    """Horizontal window over field[i, :, f] at block b; zero outside the image."""
    last = field.shape[1] - 1
    left = field[i, ti.max(b - 1, 0), f] * ti.select(b > 0, 1.0, 0.0)
    right = field[i, ti.min(b + 1, last), f] * ti.select(b < last, 1.0, 0.0)
    centre = field[i, b, f]
    total = TAPS[RADIUS] * centre
    for k in ti.static(range(1, RADIUS + 1)):
        total += TAPS[RADIUS + k] * (shifted(left, centre, right, -k) + shifted(left, centre, right, k))
    return total


@ti.kernel
def blur_luma(
    grey: L2,  # [H, B]
    out: L3,  # [H, B, 2] windowed y and y^2 in the vertical direction; rows of the border are left alone
):
    """Vertical window over an observed luminance and its square."""
    height = grey.shape[0]
    for s in range(height * SPLIT):
        i, begin, end = segment(s, grey.shape[1])
        if i >= RADIUS and i < height - RADIUS:
            for b in range(begin, end):
                y = grey[i, b]
                first, second = TAPS[RADIUS] * y, TAPS[RADIUS] * y * y
                for k in ti.static(range(1, RADIUS + 1)):
                    up, down = grey[i - k, b], grey[i + k, b]
                    first += TAPS[RADIUS + k] * (up + down)
                    second += TAPS[RADIUS + k] * (up * up + down * down)
                out[i, b, 0] = first
                out[i, b, 1] = second


@ti.kernel
def luma_statistics(
    field: L3,  # [H, B, 2] from blur_luma
    statistics: L3,  # [H, B, 2] out: mean and variance of y in the window; 0 in the border rows
):
    """Horizontal window: the observed side of SSIM, once a keyframe."""
    height = field.shape[0]
    for s in range(height * SPLIT):
        i, begin, end = segment(s, field.shape[1])
        for b in range(begin, end):
            mean, variance = Lanes(0.0), Lanes(0.0)
            if i >= RADIUS and i < height - RADIUS:
                for f in range(2):
                    statistics[i, b, f] = blurred_row(field, i, b, f)
                mean = statistics[i, b, 0]
                variance = statistics[i, b, 1] - mean * mean
            statistics[i, b, 0] = mean
            statistics[i, b, 1] = variance


@ti.kernel
def mix(
    colour: F3,  # [H, W, 3] rendered
    opacity: F2,  # [H, W]
    depth_gt: F2,  # [H, W] m
    mask: F2,  # [H, W] M_rgb in [0, 1]
    grey: L2,  # [H, B] observed y
    texture: L2,  # [H, B] 1 - T
    gain: ti.f32,
    bias: ti.f32,
    min_opacity: ti.f32,  # rendered pixels below it have no colour to compare
    min_depth_opacity: ti.f32,  # nor depth
    x: L2,  # [H, B] out: y + M (gain luma + bias - y)
    weight: L2,  # [H, B] out: M (1 - T), 0 in the border
    counts: F2,  # [H SPLIT, 3] out: sums of M, of M inside the border, of M_d
):
    """What the structure terms compare: outside the mask, the rendering is taken to agree with the observation."""
    height, width = colour.shape[0], colour.shape[1]
    for s in range(height * SPLIT):
        i, begin, end = segment(s, grey.shape[1])
        pixels, inner, measured = 0.0, 0.0, 0.0
        row_inside = (i >= RADIUS) and (i < height - RADIUS)
        for b in range(begin, end):
            y = grey[i, b]
            difference, valid = Lanes(0.0), Lanes(0.0)
            for k in ti.static(range(LANES)):
                j = ti.min(b * LANES + k, width - 1)
                inside = b * LANES + k < width
                luma = LUMA[0] * colour[i, j, 0] + LUMA[1] * colour[i, j, 1] + LUMA[2] * colour[i, j, 2]
                m = ti.select(inside and (opacity[i, j] >= min_opacity), mask[i, j], 0.0)
                column_inside = (j >= RADIUS) and (j < width - RADIUS)
                has_depth = inside and (depth_gt[i, j] > 0.0) and (opacity[i, j] > min_depth_opacity)
                pixels += m
                inner += ti.select(row_inside and column_inside, m, 0.0)
                measured += ti.select(has_depth, 1.0, 0.0)
                valid[k] = m
                difference[k] = gain * luma + bias
            x[i, b] = y + valid * (difference - y)
            weight[i, b] = valid * texture[i, b]
        counts[s, 0] = pixels
        counts[s, 1] = inner
        counts[s, 2] = measured


@ti.kernel
def blur_moments(
    x: L2,  # [H, B]
    y: L2,  # [H, B]
    out: L3,  # [H, B, 3] windowed x, x^2, x y in the vertical direction; rows of the border are left alone
):
    """Vertical window of the rendered side of SSIM."""
    height = x.shape[0]
    for s in range(height * SPLIT):
        i, begin, end = segment(s, x.shape[1])
        if i >= RADIUS and i < height - RADIUS:
            for b in range(begin, end):
                p = x[i, b]
                first = TAPS[RADIUS] * p
                square, product = first * p, first * y[i, b]
                for k in ti.static(range(1, RADIUS + 1)):
                    up, down = x[i - k, b], x[i + k, b]
                    first += TAPS[RADIUS + k] * (up + down)
                    square += TAPS[RADIUS + k] * (up * up + down * down)
                    product += TAPS[RADIUS + k] * (up * y[i - k, b] + down * y[i + k, b])
                out[i, b, 0] = first
                out[i, b, 1] = square
                out[i, b, 2] = product


@ti.kernel
def ssim(
    field: L3,  # [H, B, 3] from blur_moments
    statistics: L3,  # [H, B, 2] mean and variance of y
    weight: L2,  # [H, B]
    out: L3,  # [H, B, 3] out: weight times the derivative of 1 - SSIM by the windowed x, x^2, x y
    sums: F2,  # [H SPLIT, 1] out: weighted sum of 1 - SSIM
):
    """SSIM of luminance in the 11x11 Gaussian window and its derivatives."""
    height = field.shape[0]
    for s in range(height * SPLIT):
        i, begin, end = segment(s, field.shape[1])
        total = 0.0
        for b in range(begin, end):
            by_mean, by_square, by_product = Lanes(0.0), Lanes(0.0), Lanes(0.0)
            if i >= RADIUS and i < height - RADIUS:
                for f in range(3):  # a loop over the moments compiles the window once
                    out[i, b, f] = blurred_row(field, i, b, f)
                mx, my = out[i, b, 0], statistics[i, b, 0]
                variance = out[i, b, 1] - mx * mx
                covariance = out[i, b, 2] - mx * my
                a1, a2 = 2.0 * mx * my + C1, 2.0 * covariance + C2
                b1, b2 = 1.0 / (mx * mx + my * my + C1), 1.0 / (variance + statistics[i, b, 1] + C2)
                score, w = a1 * a2 * b1 * b2, weight[i, b]
                by_square = w * score * b2
                by_product = -2.0 * w * a1 * b1 * b2
                by_mean = -2.0 * w * (my * b1 * b2 * (a2 - a1) + mx * score * (b2 - b1))
                total += (w * (1.0 - score)).sum()
            out[i, b, 0] = by_mean
            out[i, b, 1] = by_square
            out[i, b, 2] = by_product
        sums[s, 0] = total


@ti.kernel
def blur_rows(
    field: L3,  # [H, B, 3]
    out: L3,  # [H, B, 3] out
):
    """Horizontal window over three fields; zero outside the image."""
    for s in range(field.shape[0] * SPLIT):
        i, begin, end = segment(s, field.shape[1])
        for b in range(begin, end):
            for f in range(3):
                out[i, b, f] = blurred_row(field, i, b, f)


@ti.kernel
def sobel_flow(
    x: L2,  # [H, B]
    y: L2,  # [H, B]
    weight: L2,  # [H, B]
    epsilon: ti.f32,  # Charbonnier, intensity per px
    out: L3,  # [H, B, 2] out: weight times the derivative of the penalty by the Sobel responses in x and y
    sums: F2,  # [H SPLIT, 1] out: weighted sum of the penalty
):
    """Charbonnier penalty on the length of grad x - grad y (Sobel over 8, linear, so of the gradient of x - y)."""
    height, last = x.shape[0], x.shape[1] - 1
    for s in range(height * SPLIT):
        i, begin, end = segment(s, x.shape[1])
        up, down = ti.max(i - 1, 0), ti.min(i + 1, height - 1)
        total = 0.0
        for b in range(begin, end):
            before, after = ti.max(b - 1, 0), ti.min(b + 1, last)
            smooth_l = sobel_smooth(x, y, up, i, down, before)
            smooth_c = sobel_smooth(x, y, up, i, down, b)
            smooth_r = sobel_smooth(x, y, up, i, down, after)
            step_l = sobel_step(x, y, up, down, before)
            step_c = sobel_step(x, y, up, down, b)
            step_r = sobel_step(x, y, up, down, after)
            gx = shifted(smooth_l, smooth_c, smooth_r, 1) - shifted(smooth_l, smooth_c, smooth_r, -1)
            gy = shifted(step_l, step_c, step_r, 1) + 2.0 * step_c + shifted(step_l, step_c, step_r, -1)
            root = ti.sqrt(gx * gx + gy * gy + epsilon * epsilon)
            w = weight[i, b]
            total += (w * (root - epsilon)).sum()
            out[i, b, 0] = w * gx / root
            out[i, b, 1] = w * gy / root
        sums[s, 0] = total


@ti.func
def sobel_smooth(x: ti.template(), y: ti.template(), up, row, down, b):
    """Vertical smoothing half of Sobel over x - y, divided by 8."""
    return 0.125 * (x[up, b] - y[up, b] + x[down, b] - y[down, b] + 2.0 * (x[row, b] - y[row, b]))


@ti.func
def sobel_step(x: ti.template(), y: ti.template(), up, down, b):
    """Vertical difference half of Sobel over x - y, divided by 8."""
    return 0.125 * (x[down, b] - y[down, b] - x[up, b] + y[up, b])


@ti.func
def flow_smooth(flow: ti.template(), up, row, down, b):
    """Vertical smoothing of the first component, divided by 8."""
    return 0.125 * (flow[up, b, 0] + 2.0 * flow[row, b, 0] + flow[down, b, 0])


@ti.func
def flow_step(flow: ti.template(), up, down, b):
    """Vertical difference of the second component, divided by 8 (adjoint: above minus below)."""
    return 0.125 * (flow[up, b, 1] - flow[down, b, 1])


@ti.kernel
def luma_gradient(
    x: L2,  # [H, B]
    y: L2,  # [H, B]
    field: L3,  # [H, B, 3] from blur_rows
    flow: L3,  # [H, B, 2] from sobel_flow; 0 in the border, so the adjoint needs no care there
    scale_ssim: ti.f32,
    scale_grad: ti.f32,
    out: L2,  # [H, B] out: derivative of both structure terms by x
):
    """Adjoint of the vertical window and of Sobel."""
    height, last = x.shape[0], x.shape[1] - 1
    for s in range(height * SPLIT):
        i, begin, end = segment(s, x.shape[1])
        up, down = ti.max(i - 1, 0), ti.min(i + 1, height - 1)
        for b in range(begin, end):
            by_mean = TAPS[RADIUS] * field[i, b, 0]
            by_square = TAPS[RADIUS] * field[i, b, 1]
            by_product = TAPS[RADIUS] * field[i, b, 2]
            for k in ti.static(range(1, RADIUS + 1)):
                above, below = ti.max(i - k, 0), ti.min(i + k, height - 1)
                by_mean += TAPS[RADIUS + k] * (field[above, b, 0] + field[below, b, 0])
                by_square += TAPS[RADIUS + k] * (field[above, b, 1] + field[below, b, 1])
                by_product += TAPS[RADIUS + k] * (field[above, b, 2] + field[below, b, 2])
            before, after = ti.max(b - 1, 0), ti.min(b + 1, last)
            inside_l, inside_r = ti.select(b > 0, 1.0, 0.0), ti.select(b < last, 1.0, 0.0)
            smooth_l = flow_smooth(flow, up, i, down, before) * inside_l
            smooth_c = flow_smooth(flow, up, i, down, b)
            smooth_r = flow_smooth(flow, up, i, down, after) * inside_r
            step_l = flow_step(flow, up, down, before) * inside_l
            step_c = flow_step(flow, up, down, b)
            step_r = flow_step(flow, up, down, after) * inside_r
            grad = shifted(smooth_l, smooth_c, smooth_r, -1) - shifted(smooth_l, smooth_c, smooth_r, 1)
            grad += shifted(step_l, step_c, step_r, -1) + 2.0 * step_c + shifted(step_l, step_c, step_r, 1)
            out[i, b] = scale_ssim * (by_mean + 2.0 * x[i, b] * by_square + y[i, b] * by_product) + scale_grad * grad


@ti.kernel
def colour_gradient(
    colour: F3,  # [H, W, 3] rendered
    colour_gt: F3,  # [H, W, 3]
    opacity: F2,  # [H, W]
    mask: F2,  # [H, W]
    by_luma: L2,  # [H, B] from luma_gradient
    gain: ti.f32,
    bias: ti.f32,
    min_opacity: ti.f32,
    epsilon: ti.f32,  # Charbonnier, intensity
    scale: ti.f32,  # of the intensity term
    g_colour: F3,  # [H, W, 3] out
    w_colour: F2,  # [H, W] out: curvature of the intensity term by a rendered channel, the same for all three
    sums: F2,  # [H SPLIT, 3] out: sum of the intensity penalty, derivatives by gain and by bias
):
    """Intensity term of Eq. 12, and the chain rule of all terms to the rendered colour, gain and bias.

    The curvature is that of reweighted least squares with one weight a pixel, from the mean square of its residuals.
    """
    width = colour.shape[1]
    for s in range(colour.shape[0] * SPLIT):
        i, begin, end = segment(s, by_luma.shape[1])
        total, by_gain, by_bias = 0.0, 0.0, 0.0
        for b in range(begin, end):
            luma, m, squares = by_luma[i, b], Lanes(0.0), Lanes(0.0)
            for k in ti.static(range(LANES)):
                j = ti.min(b * LANES + k, width - 1)
                m[k] = ti.select((b * LANES + k < width) and (opacity[i, j] >= min_opacity), mask[i, j], 0.0)
            for c in range(3):  # not static: a third of the code to compile
                share = ti.select(c == 0, LUMA[0], ti.select(c == 1, LUMA[1], LUMA[2]))
                value, r = Lanes(0.0), Lanes(0.0)
                for k in ti.static(range(LANES)):
                    j = ti.min(b * LANES + k, width - 1)
                    value[k] = colour[i, j, c]
                    r[k] = gain * value[k] + bias - colour_gt[i, j, c]
                squares += r * r
                root = ti.sqrt(r * r + epsilon * epsilon)
                g = m * (scale * r / root + share * luma)
                total += (m * (root - epsilon)).sum()
                by_gain += (g * value).sum()
                by_bias += g.sum()
                for k in ti.static(range(LANES)):
                    if b * LANES + k < width:
                        g_colour[i, b * LANES + k, c] = gain * g[k]
            w = m * (scale * gain * gain) / ti.sqrt(squares / 3.0 + epsilon * epsilon)
            for k in ti.static(range(LANES)):
                if b * LANES + k < width:
                    w_colour[i, b * LANES + k] = w[k]
        sums[s, 0] = total
        sums[s, 1] = by_gain
        sums[s, 2] = by_bias


@ti.kernel
def depth_gradient(
    depth: F2,  # [H, W] m, accumulated: sum of weight times depth
    opacity: F2,  # [H, W]
    depth_gt: F2,  # [H, W] m, 0 = none
    gate: F2,  # [H, W] T
    boost: ti.f32,  # residuals count 1 + boost T
    sigma_per_m2: ti.f32,  # 1/m
    epsilon: ti.f32,  # Charbonnier, in standard deviations
    min_depth_opacity: ti.f32,
    scale: ti.f32,
    g_depth: F2,  # [H, W] out
    g_opacity: F2,  # [H, W] out
    w_depth: F2,  # [H, W] out: curvature by depth, 1/m^2, of reweighted least squares
    sums: F2,  # [H SPLIT, 1] out: weighted sum of the penalty
):
    """Eq. 13 on depth / opacity, in standard deviations of the sensor's noise at the measured depth."""
    for s in range(depth.shape[0] * SPLIT):
        i, begin, end = segment(s, depth.shape[1])
        total = 0.0
        for j in range(begin, end):
            by_depth, by_opacity, curvature = 0.0, 0.0, 0.0
            z = depth_gt[i, j]
            if z > 0.0 and opacity[i, j] > min_depth_opacity:
                share = 1.0 / opacity[i, j]
                rendered = depth[i, j] * share
                per_sigma = 1.0 / (sigma_per_m2 * z * z)
                r = (rendered - z) * per_sigma
                root = ti.sqrt(r * r + epsilon * epsilon)
                w = 1.0 + boost * gate[i, j]
                total += w * (root - epsilon)
                per_metre = per_sigma * share
                curvature = scale * w / root * per_metre * per_metre
                by_depth = scale * w * (r / root) * per_metre
                by_opacity = -by_depth * rendered
            g_depth[i, j] = by_depth
            g_opacity[i, j] = by_opacity
            w_depth[i, j] = curvature
        sums[s, 0] = total
