"""Plain data shared by every layer: camera, frame, trajectory. NumPy only."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]
Matrix4 = NDArray[np.float64]


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


@dataclass(frozen=True)
class Frame:
    """One RGB-D image pair. It carries no pose: ground truth stays out of the system's reach."""

    index: int  # position in the sequence
    timestamp_s: float
    colour: FloatImage  # [H, W, 3] RGB in [0, 1], sRGB as stored
    depth_m: FloatImage  # [H, W] z in metres, 0 = no measurement


@dataclass(frozen=True)
class Trajectory:
    """Camera-to-world poses at increasing times."""

    timestamps_s: NDArray[np.float64]  # [N]
    T_wc: NDArray[np.float64]  # [N, 4, 4]

    def __len__(self) -> int:
        return len(self.timestamps_s)
