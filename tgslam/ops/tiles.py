"""The tiles that an image is blended in."""

from __future__ import annotations

from dataclasses import dataclass

from tgslam.camera import Camera
from tgslam.kernels.simd import TILE


@dataclass(frozen=True)
class Tiling:
    """How many tiles of TILE x TILE px cover an image."""

    across: int  # in a row of them
    count: int

    @classmethod
    def of(cls, camera: Camera) -> Tiling:
        """Of the camera's images."""
        across = -(-camera.width // TILE)
        return cls(across, across * -(-camera.height // TILE))
