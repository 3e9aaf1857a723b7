"""The depth camera: how it projects, and how far its depth is to be trusted. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

_NEAREST_M = 1e-3


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion: u = fx x/z + cx, pixel centres at integers, fx and fy positive."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def halved(self, times: int = 1) -> Camera:
        """The camera of an image whose 2x2 pixel blocks are averaged `times` times (odd rows and columns dropped)."""
        camera = self
        for _ in range(times):
            camera = replace(
                camera,
                width=camera.width // 2,
                height=camera.height // 2,
                fx=camera.fx / 2,
                fy=camera.fy / 2,
                cx=(camera.cx - 0.5) / 2,
                cy=(camera.cy - 0.5) / 2,
            )
        return camera

    def strided(self, step: int) -> Camera:
        """The camera of every step-th pixel and row, from the one in the middle of the first block on."""
        first = step // 2
        return Camera(
            width=len(range(first, self.width, step)),
            height=len(range(first, self.height, step)),
            fx=self.fx / step,
            fy=self.fy / step,
            cx=(self.cx - first) / step,
            cy=(self.cy - first) / step,
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Of its images: (height, width)."""
        return self.height, self.width

    @property
    def matrix(self) -> NDArray[np.float64]:
        """[3, 3] K: u z = K x."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """[4] px: fx, fy, cx, cy."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    def rays(self) -> NDArray[np.float64]:
        """[H, W, 3] what each pixel looks along, in the camera's frame, with z = 1."""
        v, u = np.mgrid[: self.height, : self.width]
        return self.rays_at(u, v)

    def rays_at(self, u: ArrayLike, v: ArrayLike) -> NDArray[np.float64]:
        """[..., 3] what places u, v [...] px look along, in the camera's frame, with z = 1."""
        x, y = (np.asarray(u) - self.cx) / self.fx, (np.asarray(v) - self.cy) / self.fy
        return np.stack([x, y, np.ones(np.shape(x))], -1)

    def points_at(self, u: ArrayLike, v: ArrayLike, depth_m: ArrayLike) -> NDArray[np.float64]:
        """[..., 3] m, camera frame: what is seen at places u, v [...] px at depths z [...] m."""
        return self.rays_at(u, v) * np.asarray(depth_m, np.float64)[..., None]

    def project(self, points_c: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where points [..., 3] m of the camera's frame appear: u, v [...] px.

        What is nearer to the camera's plane than 1 mm, or behind it, comes out as if it were so far.
        """
        z = np.maximum(points_c[..., 2], _NEAREST_M)
        return self.fx * points_c[..., 0] / z + self.cx, self.fy * points_c[..., 1] / z + self.cy

    def holds(self, u: NDArray[Any], v: NDArray[Any]) -> NDArray[np.bool_]:
        """Which places u, v [...] px, in whole pixels, are in the image."""
        inside: NDArray[np.bool_] = (u >= 0) & (v >= 0) & (u < self.width) & (v < self.height)
        return inside


@dataclass(frozen=True)
class SensorNoise:
    """How far a depth sensor errs at random: sigma_z = per_m2 * z^2. In inverse depth that is the same everywhere."""

    per_m2: float  # 1/m

    def sigma_m(self, depth_m: NDArray[Any]) -> NDArray[Any]:
        """Standard deviations [...] m of measured depths [...] m, of their dtype."""
        return self.per_m2 * depth_m**2


USUAL_NOISE = SensorNoise(0.0015)  # a Kinect's, and that of most sensors for rooms within a factor of two
