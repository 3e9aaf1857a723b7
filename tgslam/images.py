"""Image operations on device arrays: luminance, pyramids, gradients, the texture gate, normals from depth."""

from __future__ import annotations

import math

import numpy as np

from tgslam import runtime
from tgslam.arrays import require
from tgslam.kernels import image as kernels
from tgslam.types import Camera

DEPTH_EDGE = 0.05  # measurements farther apart than this part of their depth lie on different surfaces
_PERCENTILE_ROWS = 120  # the gate's percentiles come from a grid of about this many rows


def luminance(colour: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Luma 0.299 R + 0.587 G + 0.114 B of float32 [H, W, 3] -> [H, W]."""
    require("colour", colour, (None, None, 3))
    out = _output(out, colour.shape[:2])
    kernels.luminance(colour, out)
    return out


def halve(image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Mean of each 2x2 block of float32 [H, W] or [H, W, 3] -> [H // 2, W // 2(, 3)]; see `Camera.halved`."""
    size = _halved(image.shape)
    if len(image.shape) == 2:
        require("image", image, (None, None))
        out = _output(out, size)
        kernels.halve_grey(image, out)
    else:
        require("image", image, (None, None, 3))
        out = _output(out, (*size, 3))
        kernels.halve_colour(image, out)
    return out


def halve_depth(depth_m: np.ndarray, relative: float = DEPTH_EDGE, out: np.ndarray | None = None) -> np.ndarray:
    """Half-size depth: float32 [H, W] in m, 0 = none -> [H // 2, W // 2].

    Each 2x2 block gives the mean of its measurements within `relative` of the nearest one, so surfaces never mix;
    a block without measurements gives 0.
    """
    require("depth_m", depth_m, (None, None))
    out = _output(out, _halved(depth_m.shape))
    kernels.halve_depth(depth_m, relative, out)
    return out


def sobel(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sobel gradients over 8, per pixel, of float32 [H, W]: a pair of [H, W] (d/dx, d/dy), edges replicated."""
    require("image", image, (None, None))
    grad_x, grad_y = runtime.empty(image.shape), runtime.empty(image.shape)
    kernels.sobel(image, grad_x, grad_y)
    return grad_x, grad_y


def sobel_magnitude(image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Texture strength G of Eq. 10, per pixel, of float32 [H, W] -> [H, W]."""
    require("image", image, (None, None))
    out = _output(out, image.shape)
    kernels.sobel_magnitude(image, out)
    return out


def texture_gate(
    grey: np.ndarray, percentile: float = 95.0, noise_floor: float = 0.01, out: np.ndarray | None = None
) -> np.ndarray:
    """Gate T of Eq. 11, float32 [H, W] luminance -> [H, W] in [0, 1]: near 1 where there is little texture.

    percentile: G_max is this percentile of the gradient magnitude and G_min the mirrored one (95 -> 5), so one strong
    edge does not flatten the gate; both are read off a regular grid of pixels. noise_floor: epsilon of Eq. 11,
    intensity per pixel; it keeps sensor noise on a blank wall from counting as texture. A constant image gives 1.
    """
    out = sobel_magnitude(grey, out)
    step = max(1, min(grey.shape) // _PERCENTILE_ROWS)
    sample = runtime.to_host(out)[::step, ::step]
    low, high = np.percentile(sample, (100.0 - percentile, percentile))
    kernels.gate(out, low, 1.0 / (high - low + noise_floor), out)
    return out


def normals(
    depth_m: np.ndarray,
    camera: Camera,
    radius: int = 3,
    sigma_per_m2: float = 0.0015,
    steepest_rad: float = 1.3,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Unit surface normals from float32 [H, W] depth in m -> [H, W, 3], camera frame, towards the camera.

    Inverse depth of a plane is affine in the pixel, and the noise of a structured-light sensor, sigma_z =
    sigma_per_m2 z^2, is constant in inverse depth: a least-squares fit of inverse depth is the best one. There is a
    fit for each 2x2 block (an odd last row or column joins the block before), over (2 radius + 1)^2 blocks (radius 3:
    14x14 pixels), from those on the same surface: within 4 sigma plus what a plane at `steepest_rad` to the optical
    axis would rise to. (0, 0, 0) where there is no depth, where fewer than 30 % of the window are left, where the
    fit's residual exceeds 2 sigma and 0.3 % (their root sum of squares: an edge runs through it), and at pixels more
    than 4 sigma plus 1 % off the fit (the far side of an edge).
    """
    require("depth_m", depth_m, (camera.height, camera.width))
    height, width = depth_m.shape
    out = _output(out, (height, width, 3))
    blocks = runtime.empty(_halved(depth_m.shape))
    kernels.inverse_depth_blocks(depth_m, DEPTH_EDGE, blocks)
    kernels.normals(
        depth_m, blocks, camera.fx, camera.fy, camera.cx, camera.cy, radius, sigma_per_m2, math.tan(steepest_rad), out
    )
    return out


def _halved(shape: tuple[int, ...]) -> tuple[int, int]:
    height, width = shape[0] // 2, shape[1] // 2
    if not (height and width):
        raise ValueError(f"an image of {list(shape[:2])} pixels cannot be halved")
    return height, width


def _output(out: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    return runtime.empty(shape) if out is None else require("out", out, shape)
