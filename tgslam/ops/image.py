"""Image operations on device arrays: luminance, pyramids, gradients, the texture gate, normals from depth."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import alignment
from tgslam.kernels import image as kernels
from tgslam.kernels import normals as fitting
from tgslam.kernels.cuda import normals as cuda_fitting

STEEPEST_RAD = 1.3  # between a surface's normal and the optical axis
_ADOPTED_COSINE = 0.98  # of a plane's splats, whose tilts are a few degrees
_ADOPTED_MEASURED_COSINE = 0.8  # of measured normals, which noise turns by 0.1 to 0.2 rad: those turned most feign most
_ADOPTED_M, _ADOPTED_SIGMAS = 0.01, 1.5
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


def normals(
    depth_m: np.ndarray,
    camera: Camera,
    radius: int = 3,
    sigma_per_m2: float = 0.0015,
    steepest_rad: float = STEEPEST_RAD,
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
    PlaneFits(camera, radius, sigma_per_m2, steepest_rad).write(depth_m, out)
    return out


class PlaneFits:
    """`normals` for images of one size, with the scratch memory for it."""

    def __init__(self, camera: Camera, radius: int, sigma_per_m2: float, steepest_rad: float = STEEPEST_RAD) -> None:
        if not 1 <= radius <= fitting.MARGIN:
            raise ValueError(f"radius must be from 1 to {fitting.MARGIN} blocks, but is {radius}")
        height, width = halved((camera.height, camera.width))
        vectors = -(-width // fitting.LANES)
        self.camera, self._radius = camera, radius
        self._settings = runtime.to_device(
            [camera.fx, camera.fy, camera.cx, camera.cy, sigma_per_m2, math.tan(steepest_rad)]
        )
        self._blocks = runtime.zeros((height + 2 * fitting.MARGIN, vectors + 2, fitting.LANES))
        self._fits = runtime.empty((height, vectors, fitting.FIT, fitting.LANES))

    def write(self, depth_m: np.ndarray, out: np.ndarray) -> None:
        """Normals of float32 [H, W] into out [H, W, 3], or [H, W, 4] with the depth beside them."""
        with_depth = out.shape[2] == alignment.SURFACE
        require("depth_m", depth_m, (self.camera.height, self.camera.width))
        require("out", out, (*depth_m.shape, alignment.SURFACE if with_depth else 3))
        fitting.inverse_depth_blocks(depth_m, DEPTH_EDGE, self._blocks)
        if runtime.device() is runtime.Device.CUDA:
            least = fitting.least_count(self._radius)
            cuda_fitting.fit_planes(self._settings, self._blocks, self._radius, least, self._fits)
        else:
            fitting.fit_planes(self._settings, self._blocks, self._radius, self._fits)
        fitting.spread_normals(self._settings, depth_m, self._fits, with_depth, out)

    def adopt(self, planes_c: NDArray[np.float64], surface: np.ndarray, *, measured: bool = False) -> None:
        """Replace normals of surface [H, W, 4] (normal, depth in m) by those of the planes that it lies on.

        planes_c: [P, 4] unit normal and offset in m of n . x + d = 0, camera frame, the normal towards the camera. A
        pixel lies on a plane that it is off by no more than 1 cm and 1.5 sigma of the sensor's depth, and 11 degrees.
        measured: the surface is of a single depth image, not of a rendering; 37 degrees.
        """
        require("surface", surface, (self.camera.height, self.camera.width, alignment.SURFACE))
        if len(planes_c):
            least_cosine = _ADOPTED_MEASURED_COSINE if measured else _ADOPTED_COSINE
            fitting.adopt_normals(
                self._settings, runtime.to_device(planes_c), least_cosine, _ADOPTED_M, _ADOPTED_SIGMAS, surface
            )


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
