"""Differentiable splatting: the operations `forward` and `backward`, the same on every device."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.device.stopwatch import Stopwatch
from tgslam.ops.rasterize_cpu import CpuSplatting
from tgslam.ops.rasterize_cuda import CudaSplatting
from tgslam.ops.render_images import ImageGradient, RenderImages
from tgslam.ops.splats import FixedSplats, MapGradient, Splats
from tgslam.types import Gaussians, Rendering

__all__ = ["ImageGradient", "Rasterizer", "RenderImages"]


class Splatting(Protocol):
    """The stages on one device; arguments have been checked."""

    slot_count: int  # (splat, tile) pairs of the last forward pass

    @property
    def tile_count(self) -> np.ndarray:
        """[capacity] int32 device array: tiles that each Gaussian touched in the last `forward`."""
        ...

    @property
    def pair_count(self) -> int:
        """(splat, pixel) pairs that the last `forward` blended."""
        ...

    def forward(self, gaussians: Splats, pose: np.ndarray, with_embedding: bool, images: RenderImages) -> None:
        """Render into `images`. pose: device array [12], rows of [R | t] of T_cw."""
        ...

    def backward(
        self, gaussians: Splats, pose: np.ndarray, images: RenderImages, g: ImageGradient, into: MapGradient
    ) -> NDArray[np.float64]:
        """Add the gradients of the last `forward` to `into`; returns the pose's [6]."""
        ...


class Rasterizer:
    """Renders a map from any pose of one camera; holds the scratch memory, which later calls reuse."""

    def __init__(self, camera: Camera, stopwatch: Stopwatch | None = None) -> None:
        """stopwatch: takes the seconds of every stage, for benchmarks."""
        self.camera = camera
        self._images = RenderImages(
            colour=runtime.zeros((*camera.shape, 3)),
            depth=runtime.zeros(camera.shape),
            opacity=runtime.zeros(camera.shape),
            embedding=runtime.zeros((*camera.shape, 3)),
        )
        self._pose = runtime.zeros((12,))
        self._with_embedding = False
        splatting = CudaSplatting if runtime.device() is runtime.Device.CUDA else CpuSplatting
        self._splatting: Splatting = splatting(camera, stopwatch)

    def forward(self, gaussians: Splats, T_cw: ArrayLike, *, with_embedding: bool = False) -> RenderImages:
        """Render the map from the pose T_cw [4, 4] (world to camera).

        The result stays valid until the next call. Raises ValueError for a pose that is not a finite 4x4 matrix.
        """
        T_cw = np.asarray(T_cw, np.float64)
        if T_cw.shape != (4, 4) or not np.isfinite(T_cw).all():
            raise ValueError(f"T_cw must be a finite [4, 4] matrix, got shape {T_cw.shape}")
        self._with_embedding = with_embedding
        runtime.upload(T_cw[:3].reshape(12), self._pose)
        self._splatting.forward(gaussians, self._pose, with_embedding, self._images)
        return self._images

    def backward(self, gaussians: Splats, g: ImageGradient, into: MapGradient) -> NDArray[np.float64]:
        """Add the gradients of the last `forward` (same map, unchanged) to `into`; returns that of the pose.

        Returns: [6] (rotation, translation), of the left perturbation exp(xi) T_cw.
        """
        if g.embedding is not None and not self._with_embedding:
            raise ValueError("an embedding gradient needs a forward pass with_embedding=True")
        return self._splatting.backward(gaussians, self._pose, self._images, g, into)

    def render(self, gaussians: Gaussians | Splats, T_cw: ArrayLike) -> Rendering:
        """Render to host arrays; see `RenderImages.rendering`."""
        if isinstance(gaussians, Gaussians):
            gaussians = FixedSplats.of(gaussians)
        return self.forward(gaussians, T_cw).rendering()

    @property
    def tile_count(self) -> np.ndarray:
        """[capacity] int32 device array: tiles that each Gaussian touched in the last `forward`, 0 = not rendered."""
        return self._splatting.tile_count

    def visible(self, count: int) -> NDArray[np.bool_]:
        """[count] which Gaussians the last `forward` found inside the image."""
        return runtime.to_host(self.tile_count)[:count] > 0

    @property
    def slot_count(self) -> int:
        """(Gaussian, tile) pairs of the last `forward`."""
        return self._splatting.slot_count

    @property
    def pair_count(self) -> int:
        """(Gaussian, pixel) pairs that the last `forward` blended, and `backward` will: what culling has left."""
        return self._splatting.pair_count
