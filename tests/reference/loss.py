"""The RGB-depth objective in float64 NumPy and SciPy: the value only, gradients come from central differences."""

import numpy as np
from scipy.ndimage import convolve1d, gaussian_filter

from tests.reference.image import luminance

BORDER = 5


def charbonnier(r, epsilon):
    return np.sqrt(r**2 + epsilon**2) - epsilon


def window(image):
    return gaussian_filter(image, 1.5, radius=BORDER, mode="constant")


def ssim_map(x, y):
    mx, my = window(x), window(y)
    vx, vy, cov = window(x * x) - mx**2, window(y * y) - my**2, window(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    return (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))


def gradient_length_penalty(difference, epsilon):
    step, smooth = np.array([1, 0, -1]) / 2, np.array([1, 2, 1]) / 4
    gx = convolve1d(convolve1d(difference, step, axis=1), smooth, axis=0)
    gy = convolve1d(convolve1d(difference, step, axis=0), smooth, axis=1)
    return charbonnier(np.hypot(gx, gy), epsilon)


def parts(colour, depth, opacity, gt, gain, bias, config, min_opacity=0.0):
    """gt: dict of float64 colour, depth, mask and gate (T)."""
    penalties, boost = config.expert.penalties, config.expert.texture.gate_depth_boost
    mask = gt["mask"] * (opacity >= min_opacity)
    y = luminance(gt["colour"])
    x = y + mask * (gain * luminance(colour) + bias - y)
    inner = np.zeros_like(mask)
    inner[BORDER:-BORDER, BORDER:-BORDER] = mask[BORDER:-BORDER, BORDER:-BORDER]
    texture = 1 - gt["gate"]
    measured = (gt["depth"] > 0) & (opacity > penalties.min_depth_opacity)
    sigma = config.noise.per_m2 * np.where(measured, gt["depth"], 1) ** 2
    residual = (depth / np.where(measured, opacity, 1) - gt["depth"]) / sigma
    geo = (1 + boost * gt["gate"]) * charbonnier(residual, penalties.charbonnier_depth_sigmas)
    l1 = charbonnier(gain * colour + bias - gt["colour"], penalties.charbonnier_colour).mean(axis=2)
    grad = texture * gradient_length_penalty(x - y, penalties.charbonnier_grad)
    return {
        "l1": _mean(l1, mask),
        "grad": _mean(grad, inner),
        "ssim": _mean(texture * (1 - ssim_map(x, y)), inner),
        "geo": _mean(geo, measured),
    }


def value(colour, depth, opacity, gt, gain, bias, config, min_opacity=0.0):
    p = parts(colour, depth, opacity, gt, gain, bias, config, min_opacity)
    photometric = config.weight_l1 * p["l1"] + config.weight_grad * p["grad"] + config.weight_ssim * p["ssim"]
    return config.weight_pho * photometric + config.weight_geo * p["geo"]


def _mean(image, weight):
    return (image * weight).sum() / weight.sum() if weight.sum() > 0 else 0.0
