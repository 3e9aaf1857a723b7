"""Image operations on device arrays: luminance, pyramids, gradients and the texture gate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import alignment
from tgslam.kernels import image as kernels

DEPTH_EDGE = 0.05  # measurements farther apart than this part of their depth lie on different surfaces
UNGATED = (-1.0, 1.0)  # in place of what `gate_range` returns: T = 0 for a gradient of any length
_SAMPLE_ROWS = 120  # percentiles come from a grid of about this many rows


def luminance(colour: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Luma 0.299 R + 0.587 G + 0.114 B of float32 [H, W, 3] -> [H, W]."""
    require("colour", colour, (None, None, 3))
    out = _output(out, colour.shape[:2])
    kernels.luminance(colour, out)
    return out


def halve(image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
    """Mean of each 2x2 block of float32 [H, W] or [H, W, 3] -> [H // 2, W // 2(, 3)]; see `Camera.halved`."""
    size = halved(image.shape)
    if len(image.shape) == 2:
        require("image", image, (None, None))
        out = _output(out, size)
        kernels.halve_grey(image, out)
    else:
        require("image", image, (None, None, 3))
        out = _output(out, (*size, 3))
        kernels.halve_colour(image, out)
    return out


def reduce_frame(colour: np.ndarray, depth_m: np.ndarray, grey: np.ndarray, reduced_m: np.ndarray) -> None:
    """Write luminance and depth of a frame, [H, W, 3] and [H, W], into images of its size or of half of it."""
    size = _reduction(colour, depth_m, grey, reduced_m)
    kernels.reduce_frame(colour, depth_m, size, DEPTH_EDGE, grey, reduced_m)


def reduce_rendering(
    colour: np.ndarray,
    depth: np.ndarray,
    opacity: np.ndarray,
    min_opacity: float,
    grey: np.ndarray,
    reduced_m: np.ndarray,
    cover: np.ndarray,
) -> None:
    """Write luminance, depth and opacity of a rendering (depth accumulated) into images of its size or of half of it.

    Pixels of no more than min_opacity have no depth. Colours are fitted to be seen over black and are not divided.
    """
    size = _reduction(colour, depth, grey, reduced_m)
    require("opacity", opacity, depth.shape)
    require("cover", cover, grey.shape)
    kernels.reduce_rendering(colour, depth, opacity, min_opacity, size, DEPTH_EDGE, grey, reduced_m, cover)


def mark_rims(half_cover: np.ndarray, whole: float, surface: np.ndarray) -> None:
    """Make the depth of surface [H, W, SURFACE] negative at the map's rim.

    That is where the rendering's opacity, halved [H // 2, W // 2], is below `whole` in the mean over some 6 x 6 pixels:
    gaps between Gaussians are narrower.
    """
    require("surface", surface, (None, None, alignment.SURFACE))
    require("half_cover", half_cover, halved(surface.shape))
    kernels.mark_rims(half_cover, whole, surface)


def halve_pair(grey: np.ndarray, depth_m: np.ndarray, half_grey: np.ndarray, half_m: np.ndarray) -> None:
    """`halve` and `halve_depth` of images [H, W] in one pass."""
    require("grey", grey, (None, None))
    require("depth_m", depth_m, grey.shape)
    require("half_grey", half_grey, halved(grey.shape))
    require("half_m", half_m, half_grey.shape)
    kernels.halve_pair(grey, depth_m, DEPTH_EDGE, half_grey, half_m)


def halve_depth(depth_m: np.ndarray, relative: float = DEPTH_EDGE, out: np.ndarray | None = None) -> np.ndarray:
    """Half-size depth: float32 [H, W] in m, 0 = none -> [H // 2, W // 2].

    Each 2x2 block gives the mean, in inverse depth, of its measurements within `relative` of the nearest one, so that
    surfaces never mix; a block without measurements gives 0.
    """
    require("depth_m", depth_m, (None, None))
    out = _output(out, halved(depth_m.shape))
    kernels.halve_depth(depth_m, relative, out)
    return out


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
    low, inverse_range = gate_range(sampled(out), percentile, noise_floor)
    kernels.gate(out, low, inverse_range, out)
    return out


def gate_range(strength: NDArray[np.float32], percentile: float, noise_floor: float) -> tuple[float, float]:
    """G_min of Eq. 11 and 1 / (G_max - G_min + epsilon) from sampled gradient magnitudes; see `texture_gate`."""
    ordered = np.sort(strength, axis=None)
    low, high = (_percentile(ordered, p) for p in (100.0 - percentile, percentile))
    return low, 1.0 / (high - low + noise_floor)


def sample_step(shape: tuple[int, ...]) -> int:
    """Pixels between those of a regular grid that stands for an image of that shape."""
    return max(1, min(shape[:2]) // _SAMPLE_ROWS)


def sampled(image: np.ndarray) -> NDArray[np.float32]:
    """A regular grid of some 120 rows of float32 [H, W], on the host: for percentiles."""
    step = sample_step(image.shape)
    sample = runtime.empty((-(-image.shape[0] // step), -(-image.shape[1] // step)))
    kernels.sample_grid(image, step, sample)
    return runtime.to_host(sample)


def median_of_measured(depth_m: np.ndarray) -> float:
    """Of a grid of what is measured in [H, W] m, 0 = none, on the device; infinite where nothing is."""
    sample = sampled(depth_m)
    measured = sample[sample > 0]
    return float(np.median(measured)) if len(measured) else np.inf


def _percentile(ordered: NDArray[np.float32], percentile: float) -> float:
    """As `np.percentile`, of values in ascending order: several then need one sort."""
    rank = percentile / 100.0 * (ordered.size - 1)
    below = int(rank)
    low, high = float(ordered[below]), float(ordered[min(below + 1, ordered.size - 1)])
    return low + (rank - below) * (high - low)


def _reduction(colour: np.ndarray, depth: np.ndarray, grey: np.ndarray, reduced: np.ndarray) -> int:
    """Pixels that become one, 1 or 2, either way."""
    height, width = require("colour", colour, (None, None, 3)).shape[:2]
    require("depth", depth, (height, width))
    size = 1 if tuple(grey.shape) == (height, width) else 2
    require("grey", grey, (height // size, width // size))
    require("reduced", reduced, grey.shape)
    return size


def halved(shape: tuple[int, ...]) -> tuple[int, int]:
    """(height, width) of an image that begins with those, halved. Raises ValueError where nothing would be left."""
    height, width = shape[0] // 2, shape[1] // 2
    if not (height and width):
        raise ValueError(f"an image of {list(shape[:2])} pixels cannot be halved")
    return height, width


def _output(out: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    return runtime.empty(shape) if out is None else require("out", out, shape)
