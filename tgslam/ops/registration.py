"""Depth of a camera of its own, brought into the pixels of the colour camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import USUAL_NOISE, Camera
from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import registration as kernels
from tgslam.ops.depth import STEEPEST
from tgslam.types import FloatImage, Matrix4

_TOLERANCE_SIGMAS = 4.2  # three sigma of a difference of two measurements


class Registration:
    """What the depth camera measures, as the colour camera would: the nearest surface that each of its pixels meets.

    Between neighbouring measurements that agree in depth there is a surface; elsewhere nothing is made up.
    """

    def __init__(self, rays: NDArray[np.float64], T_colour_depth: Matrix4, colour: Camera) -> None:
        """rays: [H, W, 2] x/z and y/z that the pixels of the depth camera look along. T_colour_depth: [4, 4]."""
        self._camera, self.stored_shape = colour, (rays.shape[0], rays.shape[1])
        self._rays = runtime.to_device(rays)
        self._T_cd = runtime.to_device(T_colour_depth[:3])
        self._intrinsics = runtime.to_device(colour.intrinsics)
        self._slope = STEEPEST * float(np.median(np.abs(np.diff(rays[..., 0], axis=1))))

    def __call__(self, depth_m: FloatImage) -> FloatImage:
        """Depth [H, W] m of the depth camera, 0 = none -> [h, w] of the colour camera, a new array on the host."""
        placed = runtime.empty((*require("depth_m", depth_m, self.stored_shape).shape, 3))
        depth, agreement = runtime.to_device(depth_m), (USUAL_NOISE.per_m2, _TOLERANCE_SIGMAS, self._slope)
        kernels.place(depth, self._rays, self._T_cd, self._intrinsics, placed)
        surfaces, points = (runtime.empty(self._camera.shape, np.int32) for _ in range(2))
        for nearest in (surfaces, points):
            nearest.fill(kernels.NOTHING)
        kernels.draw_surfaces(depth, placed, *agreement, surfaces)
        kernels.draw_points(placed, points)
        registered = runtime.empty(self._camera.shape)
        kernels.nearest_of(surfaces, points, *agreement, registered)
        return runtime.to_host(registered)
