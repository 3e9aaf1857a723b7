"""The depth camera: how it projects, and how far its depth is to be trusted. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


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

    def rays(self) -> NDArray[np.float64]:
        """[H, W, 3] what each pixel looks along, in the camera's frame, with z = 1."""
        v, u = np.mgrid[: self.height, : self.width]
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)], -1)
