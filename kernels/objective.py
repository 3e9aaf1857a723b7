"""The terms of the adaptive RGB-depth objective, Eqs. 12 and 13, at a pixel: for scalars and for `Lanes` alike.

Every term is a mean over its pixels. The kernels sum first, into an array of TOTALS, and what divides by a count reads
it from there: nothing goes to the host in between.
"""

import math

import taichi as ti

RADIUS = 5  # px: the usual 11x11 SSIM window, and the border that the gradient and SSIM terms leave out
SIGMA = 1.5  # px
C1, C2 = 0.01**2, 0.03**2  # the usual SSIM constants for intensities in [0, 1]
LUMA = (0.299, 0.587, 0.114)
_BELL = [math.exp(-0.5 * (k / SIGMA) ** 2) for k in range(-RADIUS, RADIUS + 1)]
TAPS = tuple(tap / sum(_BELL) for tap in _BELL)
MOMENTS = 3  # fields under the SSIM window: x, x^2, x y
SLOPES = MOMENTS + 2  # derivatives by them, and by the two Sobel responses

# Sums over the image: M, M inside the border, M_d, then weighted penalties and derivatives by gain and bias
PIXELS, INNER, DEPTHS, SSIM, GRAD, L1, GAIN, BIAS, GEO = range(9)
TOTALS = 9
STRUCTURE = L1  # columns before this one are known before the gradient, the rest with it


@ti.func
def share(weight, count):
    """What a unit of a sum counts in its weighted mean; 0 for a mean over nothing."""
    return ti.select(count > 0.0, weight / ti.max(count, 1e-30), 0.0)


@ti.func
def charbonnier_root(square, epsilon):
    """Charbonnier's penalty plus epsilon: sqrt(r^2 + epsilon^2)."""
    return ti.sqrt(square + epsilon * epsilon)


@ti.func
def mixed(luma, observed, valid, gain, bias):
    """Rendered luminance as the structure terms see it: outside the mask it agrees with the observation."""
    return observed + valid * (gain * luma + bias - observed)


@ti.func
def ssim_slopes(mx, xx, xy, my, vy, weight):
    """Weighted 1 - SSIM and its derivatives by the windowed x, x^2, x y; my, vy: mean and variance of y."""
    variance, covariance = xx - mx * mx, xy - mx * my
    a1, a2 = 2.0 * mx * my + C1, 2.0 * covariance + C2
    b1, b2 = 1.0 / (mx * mx + my * my + C1), 1.0 / (variance + vy + C2)
    both = b1 * b2
    score = a1 * a2 * both
    by_mean = -2.0 * weight * (my * both * (a2 - a1) + mx * score * (b2 - b1))
    return weight * (1.0 - score), by_mean, weight * score * b2, -2.0 * weight * a1 * both


@ti.func
def flow_slopes(gx, gy, weight, epsilon):
    """Weighted Charbonnier penalty on the length of (gx, gy), and its derivatives by both."""
    root = charbonnier_root(gx * gx + gy * gy, epsilon)
    per_root = weight / root
    return weight * (root - epsilon), gx * per_root, gy * per_root


@ti.func
def depth_slopes(depth, opacity, observed, weight, sigma_per_m2, epsilon):
    """Weighted penalty of Eq. 13 on depth / opacity, and before its mean: derivatives by both, curvature by depth.

    observed and opacity must not be 0; weight is 0 where they stand in for a missing measurement.
    """
    per_opacity = 1.0 / opacity
    rendered = depth * per_opacity
    per_sigma = 1.0 / (sigma_per_m2 * observed * observed)
    r = (rendered - observed) * per_sigma
    root = charbonnier_root(r * r, epsilon)
    per_metre = per_sigma * per_opacity
    slope = weight / root * per_metre
    by_depth = slope * r
    return weight * (root - epsilon), by_depth, -1.0 * by_depth * rendered, slope * per_metre
