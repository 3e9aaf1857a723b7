"""Differentiable splatting: the operations `forward` and `backward` round the rasterizer's kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tgslam import runtime
from tgslam.gaussian_map import GaussianMap, MapGradient
from tgslam.kernels import projection, rasterize
from tgslam.kernels.simd import CHUNKS, LANES, TILE
from tgslam.types import Camera, Gaussians, Rendering

_MOMENT_ROWS = 2  # vectors that hold a splat's moments
MIN_OPACITY = 0.5  # below it a pixel of `Rendering.depth_m` has no depth


@dataclass
class RenderImages:
    """The forward result as device arrays, overwritten by the next `forward` of the same rasterizer."""

    colour: np.ndarray  # [H, W, 3]
    depth: np.ndarray  # [H, W] m, sum of blend weight times tangent-plane depth (not divided by opacity)
    opacity: np.ndarray  # [H, W]
    embedding: np.ndarray  # [H, W, 3] instance colour, Eq. 3; written only with `with_embedding`


@dataclass
class ImageGradient:
    """dL/d(image) for `backward`, and the loss's second derivatives where `curvature` is wanted."""

    colour: np.ndarray  # [H, W, 3]
    depth: np.ndarray  # [H, W] with respect to RenderImages.depth
    opacity: np.ndarray  # [H, W]
    embedding: np.ndarray | None = None  # [H, W, 3]
    colour_weight: np.ndarray | None = None  # [H, W]
    depth_weight: np.ndarray | None = None  # [H, W]


class _SlotBuffers:
    """Scratch for one entry per (splat, tile), grown by doubling."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.ids = runtime.empty((capacity,), np.int32)
        self.entry = runtime.empty((capacity,), np.int32)
        self.todo = runtime.empty((capacity,), np.int32)
        self.mask = runtime.empty((capacity,), np.int32)
        self.slot = runtime.empty((capacity, projection.SPLAT))
        self.grad = runtime.empty((capacity, _MOMENT_ROWS, LANES))


class _SplatBuffers:
    """Scratch for one entry per Gaussian, grown with the map's capacity."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.splat = runtime.zeros((capacity, projection.SPLAT))
        self.moments = runtime.empty((capacity, _MOMENT_ROWS, LANES))
        self.tile_rect = runtime.empty((capacity, 4), np.int32)
        self.tile_count = runtime.zeros((capacity,), np.int32)
        self.first_of = runtime.zeros((capacity,), np.int32)


class Rasterizer:
    """Renders a map from any pose of one camera; holds the scratch memory, which later calls reuse."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.tiles_x = -(-camera.width // TILE)
        self.tiles = self.tiles_x * -(-camera.height // TILE)
        H, W = camera.height, camera.width
        self._camera = runtime.to_device([camera.fx, camera.fy, camera.cx, camera.cy])
        self._g = runtime.zeros((self.tiles * CHUNKS, rasterize.G, LANES), lanes=True)
        self._state = runtime.empty((self.tiles * CHUNKS, 2, LANES), lanes=True)
        self._images = RenderImages(
            runtime.zeros((H, W, 3)), runtime.zeros((H, W)), runtime.zeros((H, W)), runtime.zeros((H, W, 3))
        )
        self._no_weight = runtime.zeros((H, W))
        self._no_embedding = runtime.zeros((H, W, 3))
        self._slots = _SlotBuffers(1 << 15)
        self._splats = _SplatBuffers(1)
        self._start = runtime.zeros((self.tiles + 1,), np.int32)
        self._per_tile = runtime.zeros((self.tiles, rasterize.SEGMENTS), np.int32)
        self._pose = runtime.zeros((12,))
        self._with_embedding = False
        self.slot_count = 0

    def forward(self, gaussians: GaussianMap, T_cw: ArrayLike, *, with_embedding: bool = False) -> RenderImages:
        """Render the map from the pose T_cw [4, 4] (world to camera).

        The result stays valid until the next call. Raises ValueError for a pose that is not a finite 4x4 matrix.
        """
        T_cw = np.asarray(T_cw, np.float64)
        if T_cw.shape != (4, 4) or not np.isfinite(T_cw).all():
            raise ValueError(f"T_cw must be a finite [4, 4] matrix, got shape {T_cw.shape}")
        self._with_embedding = with_embedding
        self._pose = runtime.to_device(T_cw[:3].reshape(12))
        self._project(gaussians)
        self._list_slots(gaussians.count)
        slots, images = self._slots, self._images
        rasterize.pack_slots(
            self.tiles, self.tiles_x, self._start, slots.ids, self._splats.splat, slots.slot, slots.mask
        )
        rasterize.forward(
            self.tiles, self.tiles_x, self._start, slots.slot, slots.mask, slots.todo, with_embedding,
            images.colour, images.depth, images.opacity, images.embedding,
        )  # fmt: skip
        return images

    def backward(self, gaussians: GaussianMap, g: ImageGradient, into: MapGradient) -> NDArray[np.float64]:
        """Add the gradients of the last `forward` (same map, unchanged) to `into`; returns that of the pose.

        Returns: [6] (rotation, translation), of the left perturbation exp(xi) T_cw.
        """
        curvature = g.colour_weight is not None and g.depth_weight is not None
        embedding = g.embedding is not None
        if embedding and not self._with_embedding:
            raise ValueError("an embedding gradient needs a forward pass with_embedding=True")
        slots, splats, images, n = self._slots, self._splats, self._images, gaussians.count
        rasterize.pack_gradient(
            self.tiles, self.tiles_x, embedding, curvature,
            images.colour, images.depth, images.opacity, images.embedding,
            g.colour, g.depth, g.opacity, g.embedding if embedding else self._no_embedding,
            g.colour_weight if curvature else self._no_weight, g.depth_weight if curvature else self._no_weight,
            self._g,
        )  # fmt: skip
        rasterize.backward(
            self.tiles, self._start, slots.slot, slots.mask, slots.entry, self._g, embedding, curvature,
            self._state, slots.grad,
        )  # fmt: skip
        rasterize.gather_gradients(n, splats.tile_count, splats.first_of, embedding, slots.grad, splats.moments)
        blocks = runtime.zeros((max(1, -(-n // projection.POSE_BLOCK)), 6))
        projection.project_backward(
            n, gaussians.mean, gaussians.log_scale, gaussians.quat_wxyz, gaussians.opacity_logit, gaussians.embedding,
            self._pose, self._camera, self.camera.width, self.camera.height, embedding, splats.tile_count,
            splats.moments.reshape(splats.capacity, -1),
            into.mean, into.log_scale, into.quat_wxyz, into.opacity_logit, into.colour, into.embedding, into.curvature,
            blocks,
        )  # fmt: skip
        return runtime.to_host(blocks).sum(0, dtype=np.float64)

    def render(self, gaussians: Gaussians | GaussianMap, T_cw: ArrayLike) -> Rendering:
        """Render to host arrays, with depth divided by opacity (0 where opacity < MIN_OPACITY)."""
        if isinstance(gaussians, Gaussians):
            gaussians = GaussianMap.from_gaussians(gaussians)
        images = self.forward(gaussians, T_cw)
        opacity = runtime.to_host(images.opacity).copy()
        depth = runtime.to_host(images.depth)
        depth_m = np.where(opacity >= MIN_OPACITY, depth / np.maximum(opacity, MIN_OPACITY), 0.0).astype(np.float32)
        return Rendering(runtime.to_host(images.colour).copy(), depth_m, opacity)

    @property
    def tile_count(self) -> np.ndarray:
        """[capacity] int32 device array: tiles that each Gaussian touched in the last `forward`, 0 = not rendered."""
        return self._splats.tile_count

    def visible(self, count: int) -> NDArray[np.bool_]:
        """[count] which Gaussians the last `forward` found inside the image."""
        return runtime.to_host(self._splats.tile_count)[:count] > 0

    def _project(self, gaussians: GaussianMap) -> None:
        """Splat rows, and the tiles that each Gaussian touches."""
        if self._splats.capacity < gaussians.capacity:
            self._splats = _SplatBuffers(gaussians.capacity)
        splats = self._splats
        projection.project(
            gaussians.count, gaussians.mean, gaussians.log_scale, gaussians.quat_wxyz, gaussians.opacity_logit,
            gaussians.colour, gaussians.embedding, self._pose, self._camera, self.camera.width, self.camera.height,
            self._with_embedding, splats.splat, splats.tile_rect, splats.tile_count,
        )  # fmt: skip

    def _list_slots(self, count: int) -> None:
        """List each tile's splats in depth order (equal depths by index)."""
        splats = self._splats
        tile_count = runtime.to_host(splats.tile_count)[:count]
        ends = np.cumsum(tile_count, dtype=np.int32)
        self.slot_count = int(ends[-1]) if count else 0
        if self.slot_count > self._slots.capacity:
            self._slots = _SlotBuffers(max(2 * self._slots.capacity, self.slot_count))
        np.subtract(ends, tile_count, out=splats.first_of[:count])
        visible = np.flatnonzero(tile_count)
        order = _depth_order(runtime.to_host(splats.splat)[visible, projection.Z], visible)
        rasterize.count_slots(len(order), order, splats.tile_rect, self.tiles_x, self._per_tile)
        ends = np.cumsum(self._per_tile, dtype=np.int32)
        self._start[1:] = ends[rasterize.SEGMENTS - 1 :: rasterize.SEGMENTS]
        cursor = (ends - self._per_tile.ravel()).reshape(self._per_tile.shape)
        rasterize.fill_slots(
            len(order), order, splats.tile_rect, self.tiles_x, cursor, splats.first_of,
            self._slots.ids, self._slots.entry,
        )  # fmt: skip


def _depth_order(depth_m: NDArray[np.float32], index: NDArray[np.intp]) -> NDArray[np.int32]:
    """`index` sorted by (depth, index): positive floats order like their bits, so one integer sort does both."""
    keys = (depth_m.view(np.uint32).astype(np.int64) << 32) | index
    keys.sort()
    return (keys & 0xFFFFFFFF).astype(np.int32)
