"""How the map's Gaussians stand to what a keyframe's sensor saw."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.gaussian_map import GaussianMap
from tgslam.geometry import matrix_from_quat_wxyz, transform_points
from tgslam.mapping.keyframe import Keyframe
from tgslam.types import Camera

_NEAR_M = 0.05


class Projection:
    """Where the centres of the map's Gaussians lie in an image."""

    def __init__(self, gaussians: GaussianMap, camera: Camera, T_cw: NDArray[np.float64]) -> None:
        x = transform_points(T_cw, gaussians.host("mean"))
        self.z = np.maximum(x[:, 2], 1e-3)  # [N] m
        self.exact_u = camera.fx * x[:, 0] / self.z + camera.cx  # [N] px
        self.exact_v = camera.fy * x[:, 1] / self.z + camera.cy  # [N] px
        u, v = np.rint(self.exact_u), np.rint(self.exact_v)
        self.inside = (x[:, 2] > _NEAR_M) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)  # [N]
        self.u, self.v = u[self.inside].astype(int), v[self.inside].astype(int)  # [inside] px
        self._camera, self._T_cw = camera, T_cw

    def longest_px(self, gaussians: GaussianMap) -> NDArray[np.float64]:
        """[inside] px, standard deviation along the axis that is longest in the image."""
        rows = np.flatnonzero(self.inside)
        turns = self._T_cw[:3, :3] @ matrix_from_quat_wxyz(gaussians.host("quat_wxyz")[rows])
        axes = turns * np.exp(gaussians.host("log_scale")[rows].astype(np.float64))[:, None]  # [inside, 3, 3] columns
        z = self.z[rows, None]
        x = (self.exact_u[rows, None] - self._camera.cx) / self._camera.fx
        y = (self.exact_v[rows, None] - self._camera.cy) / self._camera.fy
        across = self._camera.fx / z * (axes[:, 0] - x * axes[:, 2])
        down = self._camera.fy / z * (axes[:, 1] - y * axes[:, 2])
        longest: NDArray[np.float64] = np.hypot(across, down).max(axis=1)
        return longest


class Surface(Projection):
    """Which Gaussians a keyframe's depth supports, and which it sees through."""

    def __init__(self, keyframe: Keyframe, camera: Camera, gaussians: GaussianMap, margin_per_m2: float) -> None:
        super().__init__(gaussians, camera, keyframe.T_cw)
        depth_m = keyframe.depth_m()
        # The nearest measurement around decides, so that an edge pixel off by one does not speak against a surface
        nearest = cv2.erode(np.where(depth_m > 0, depth_m, np.inf), np.ones((3, 3)), borderValue=np.inf)
        surface = np.full(len(self.z), np.inf)
        surface[self.inside] = nearest[self.v, self.u]
        self.measured = np.isfinite(surface)  # [N] there is depth where the Gaussian projects to
        margin = margin_per_m2 * np.where(self.measured, surface, 0.0) ** 2
        self.seen_through = self.measured & (self.z < surface - margin)  # [N]
        self.supported = self.measured & (np.abs(self.z - surface) <= margin)  # [N]
