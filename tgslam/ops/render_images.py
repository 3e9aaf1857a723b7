"""What a rasterizer gives and takes: images on the device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tgslam.device import runtime
from tgslam.types import Rendering

MIN_OPACITY = 0.5  # below it a pixel of `Rendering.depth_m` has no depth


@dataclass
class RenderImages:
    """The forward result as device arrays, overwritten by the next `forward` of the same rasterizer."""

    colour: np.ndarray  # [H, W, 3]
    depth: np.ndarray  # [H, W] m, sum of blend weight times tangent-plane depth (not divided by opacity)
    opacity: np.ndarray  # [H, W]
    embedding: np.ndarray  # [H, W, 3] instance colour, Eq. 3; written only with `with_embedding`

    def rendering(self) -> Rendering:
        """Copies on the host, with depth divided by opacity (0 where opacity < MIN_OPACITY)."""
        opacity = runtime.to_host(self.opacity).copy()
        depth = runtime.to_host(self.depth)
        depth_m = np.where(opacity >= MIN_OPACITY, depth / np.maximum(opacity, MIN_OPACITY), 0.0).astype(np.float32)
        return Rendering(runtime.to_host(self.colour).copy(), depth_m, opacity)


@dataclass
class ImageGradient:
    """dL/d(image) for `backward`, and the loss's second derivatives where `curvature` is wanted."""

    colour: np.ndarray  # [H, W, 3]
    depth: np.ndarray  # [H, W] with respect to RenderImages.depth
    opacity: np.ndarray  # [H, W]
    embedding: np.ndarray | None = None  # [H, W, 3]
    colour_weight: np.ndarray | None = None  # [H, W]
    depth_weight: np.ndarray | None = None  # [H, W]


@dataclass(frozen=True)
class AbsentGradient:
    """In place of what an `ImageGradient` leaves out: kernels take the arrays, and do not read them."""

    weight: np.ndarray  # [H, W]
    embedding: np.ndarray  # [H, W, 3]

    @classmethod
    def of_size(cls, height: int, width: int) -> AbsentGradient:
        """Zeros."""
        return cls(runtime.zeros((height, width)), runtime.zeros((height, width, 3)))
