"""How the map's Gaussians stand to what a keyframe's sensor saw."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.geometry import matrix_from_quat_wxyz, transform_points
from tgslam.map.gaussians import GaussianMap
from tgslam.ops.splats import IMAGE_EDGE

_NEAR_M = 0.05
_HIDDEN = 1.25  # times the depth at a pixel: what lies farther is behind another surface


class Projection:
    """Where the centres of the map's Gaussians lie in an image."""

    def __init__(self, gaussians: GaussianMap, camera: Camera, T_cw: NDArray[np.float64]) -> None:
        x = transform_points(T_cw, gaussians.host("mean"))
        self.z = np.maximum(x[:, 2], 1e-3)  # [N] m
        self.exact_u, self.exact_v = camera.project(x)  # [N] px
        u, v = np.rint(self.exact_u), np.rint(self.exact_v)
        self.ahead = x[:, 2] > _NEAR_M  # [N]
        self.inside = self.ahead & camera.holds(u, v)  # [N]
        self.u, self.v = u[self.inside].astype(int), v[self.inside].astype(int)  # [inside] px
        self._camera, self._T_cw = camera, T_cw

    def axes_px(self, gaussians: GaussianMap, rows: NDArray[np.intp]) -> NDArray[np.float64]:
        """[n, 3] px, standard deviations along the axes of these rows [n], ahead of the camera, in the image."""
        axes, z = self._axes(gaussians, rows), self.z[rows, None]
        camera, u, v = self._camera, self.exact_u[rows, None], self.exact_v[rows, None]
        x = _in_view(u, camera.cx, camera.fx, camera.width)
        y = _in_view(v, camera.cy, camera.fy, camera.height)
        across = camera.fx / z * (axes[:, 0] - x * axes[:, 2])
        down = camera.fy / z * (axes[:, 1] - y * axes[:, 2])
        lengths: NDArray[np.float64] = np.hypot(across, down)
        return lengths

    def axes_depth(self, gaussians: GaussianMap, rows: NDArray[np.intp]) -> NDArray[np.float64]:
        """[n, 3] likewise of the depth, relative to the centre's."""
        depths: NDArray[np.float64] = np.abs(self._axes(gaussians, rows)[:, 2]) / self.z[rows, None]
        return depths

    def _axes(self, gaussians: GaussianMap, rows: NDArray[np.intp]) -> NDArray[np.float64]:
        """[n, 3, 3] m, columns in the camera's frame, each as long as the standard deviation."""
        turns = self._T_cw[:3, :3] @ matrix_from_quat_wxyz(gaussians.host("quat_wxyz")[rows])
        axes: NDArray[np.float64] = turns * np.exp(gaussians.host("log_scale")[rows].astype(np.float64))[:, None]
        return axes

    def inside_by(self, margin_px: NDArray[np.float64]) -> NDArray[np.bool_]:
        """[N] ahead of the camera and in the image, that many pixels [N] from its rim; less than 0: beyond it."""
        column = np.minimum(self.exact_u, self._camera.width - 1 - self.exact_u)
        row = np.minimum(self.exact_v, self._camera.height - 1 - self.exact_v)
        return self.ahead & (column >= margin_px) & (row >= margin_px)


def _in_view(pixel: NDArray[np.float64], centre: float, focal: float, size: int) -> NDArray[np.float64]:
    """x/z (or y/z), limited as when splats are projected (`kernels.projection.in_view`)."""
    beyond = 0.5 * (IMAGE_EDGE - 1.0) * size
    ratio: NDArray[np.float64] = (np.clip(pixel, -beyond, size + beyond) - centre) / focal
    return ratio


class Surface(Projection):
    """Which Gaussians a keyframe's depth supports, and which it sees through."""

    def __init__(
        self,
        depth_m: NDArray[np.float32],
        T_cw: NDArray[np.float64],
        camera: Camera,
        gaussians: GaussianMap,
        margin_per_m2: float,
    ) -> None:
        """depth_m: [H, W] m, measured at T_cw [4, 4]. margin_per_m2: how far a Gaussian may be off, times depth^2."""
        super().__init__(gaussians, camera, T_cw)
        # The nearest measurement around decides, so that an edge pixel off by one does not speak against a surface
        nearest = cv2.erode(np.where(depth_m > 0, depth_m, np.inf), np.ones((3, 3)), borderValue=np.inf)
        surface = np.full(len(self.z), np.inf)
        surface[self.inside] = nearest[self.v, self.u]
        self.measured = np.isfinite(surface)  # [N] there is depth where the Gaussian projects to
        margin = margin_per_m2 * np.where(self.measured, surface, 0.0) ** 2
        self.seen_through = self.measured & (self.z < surface - margin)  # [N]
        self.supported = self.measured & (np.abs(self.z - surface) <= margin)  # [N]
        # [N] each, the pixel: beyond the image the nearest of its rim, where surfaces go on
        column = np.clip(np.rint(self.exact_u), 0, camera.width - 1).astype(int)
        self.nearest_pixel = np.clip(np.rint(self.exact_v), 0, camera.height - 1).astype(int), column
        self.not_hidden = self.ahead & (self.z < _HIDDEN * depth_m[self.nearest_pixel])  # [N]
