"""Surface normals from depth images."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import alignment
from tgslam.kernels import normals as kernels
from tgslam.kernels.cuda import normals as cuda_kernels
from tgslam.ops.image import DEPTH_EDGE, halved

_STEEPEST_RAD = 1.3  # between a surface's normal and the optical axis: more grazing ones are mostly edges
_ADOPTED_COSINE = 0.98  # of a plane's splats, whose tilts are a few degrees
_ADOPTED_MEASURED_COSINE = 0.8  # of measured normals, which noise turns by 0.1 to 0.2 rad: those turned most feign most
_ADOPTED_M, _ADOPTED_SIGMAS = 0.01, 1.5  # from a plane; what stands off farther is another surface


def normals_of(
    depth_m: np.ndarray, camera: Camera, noise: SensorNoise, radius: int = 3, out: np.ndarray | None = None
) -> np.ndarray:
    """Unit surface normals from float32 [H, W] depth in m -> [H, W, 3], camera frame, towards the camera.

    Inverse depth of a plane is affine in the pixel, and the noise of a structured-light sensor is constant in inverse
    depth: a least-squares fit of inverse depth is the best one. There is a fit for each 2x2 block (an odd last row or
    column joins the block before), over (2 radius + 1)^2 blocks (radius 3: 14x14 pixels), from those on the same
    surface: within 4 sigma plus what a plane at 1.3 rad to the optical axis would rise to. (0, 0, 0) where there is no
    depth, where fewer than 30 % of the window are left, where the fit's residual exceeds 2 sigma and 0.3 % (their root
    sum of squares: an edge runs through it), and at pixels more than 4 sigma plus 1 % off the fit (the far side of an
    edge).
    """
    require("depth_m", depth_m, camera.shape)
    shape = (*camera.shape, 3)
    out = runtime.empty(shape) if out is None else require("out", out, shape)
    PlaneFits(camera, radius, noise).write(depth_m, out)
    return out


class PlaneFits:
    """`normals_of` for images of one size, with the scratch memory for it."""

    def __init__(self, camera: Camera, radius: int, noise: SensorNoise) -> None:
        if not 1 <= radius <= kernels.MARGIN:
            raise ValueError(f"radius must be from 1 to {kernels.MARGIN} blocks, but is {radius}")
        height, width = halved(camera.shape)
        vectors = -(-width // kernels.LANES)
        self._camera, self._radius = camera, radius
        self._settings = runtime.to_device([*camera.intrinsics, noise.per_m2, math.tan(_STEEPEST_RAD)])
        self._blocks = runtime.zeros((height + 2 * kernels.MARGIN, vectors + 2, kernels.LANES))
        self._fits = runtime.empty((height, vectors, kernels.FIT, kernels.LANES))

    def write(self, depth_m: np.ndarray, out: np.ndarray) -> None:
        """Normals of float32 [H, W] into out [H, W, 3], or [H, W, 4] with the depth beside them."""
        with_depth = out.shape[2] == alignment.SURFACE
        require("depth_m", depth_m, self._camera.shape)
        require("out", out, (*depth_m.shape, alignment.SURFACE if with_depth else 3))
        kernels.inverse_depth_blocks(depth_m, DEPTH_EDGE, self._blocks)
        if runtime.device() is runtime.Device.CUDA:
            least = kernels.least_count(self._radius)
            cuda_kernels.fit_planes(self._settings, self._blocks, self._radius, least, self._fits)
        else:
            kernels.fit_planes(self._settings, self._blocks, self._radius, self._fits)
        kernels.spread_normals(self._settings, depth_m, self._fits, with_depth, out)

    def adopt(self, planes_c: NDArray[np.float64], surface: np.ndarray, *, measured: bool = False) -> None:
        """Replace normals of surface [H, W, 4] (normal, depth in m) by those of the planes that it lies on.

        planes_c: [P, 4] unit normal and offset in m of n . x + d = 0, camera frame, the normal towards the camera. A
        pixel lies on a plane that it is off by no more than 1 cm and 1.5 sigma of the sensor's depth, and 11 degrees.
        measured: the surface is of a single depth image, not of a rendering; 37 degrees.
        """
        require("surface", surface, (*self._camera.shape, alignment.SURFACE))
        if len(planes_c):
            least_cosine = _ADOPTED_MEASURED_COSINE if measured else _ADOPTED_COSINE
            kernels.adopt_normals(
                self._settings, runtime.to_device(planes_c), least_cosine, _ADOPTED_M, _ADOPTED_SIGMAS, surface
            )
