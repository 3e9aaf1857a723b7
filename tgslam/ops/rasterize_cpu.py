"""Splatting on the CPU: the stages round the 16-lane kernels, and their scratch memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.device.stopwatch import Stopwatch, stage
from tgslam.kernels import projection, projection_gradient, rasterize
from tgslam.kernels.simd import CHUNK, CHUNKS, LANES, PER_ROW, TILE
from tgslam.ops.render_images import AbsentGradient, ImageGradient, RenderImages
from tgslam.ops.splats import MapGradient, Splats
from tgslam.ops.tiles import Tiling

_MOMENT_ROWS = 2  # vectors that hold a splat's moments


class _SlotBuffers:
    """Scratch for one entry per (splat, tile), grown by doubling."""

    def __init__(self, capacity: int, tiles: int) -> None:
        self.capacity = capacity
        self.ids = runtime.empty((capacity,), np.int32)
        self.entry = runtime.empty((capacity,), np.int32)
        self.groups = runtime.empty((capacity // rasterize.GROUP + tiles, CHUNKS), lanes=True)
        self.mask = runtime.empty((capacity,), np.int32)
        self.slot = runtime.empty((capacity, projection.SPLAT))
        self.grad = runtime.empty((capacity, LANES), lanes=True)
        self.embedding_grad = runtime.empty((capacity, LANES), lanes=True)


class _SplatBuffers:
    """Scratch for one entry per Gaussian, grown with the map's capacity."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.splat = runtime.zeros((capacity, projection.SPLAT))
        self.moments = runtime.empty((capacity, _MOMENT_ROWS, LANES))
        self.tile_rect = runtime.empty((capacity, 4), np.int32)
        self.tile_count = runtime.zeros((capacity,), np.int32)
        self.first_of = runtime.zeros((capacity,), np.int32)
        self.by_depth = runtime.empty((capacity, 4), np.int32)


class _TileBuffers:
    """Scratch for one entry per tile."""

    def __init__(self, tiles: Tiling) -> None:
        self.start = runtime.zeros((tiles.count + 1,), np.int32)  # first slot of each, and the end of the last
        self.splats = runtime.zeros((rasterize.SEGMENTS, tiles.count + tiles.across + 1), np.int32)  # counted


class CpuSplatting:
    """Stages of `forward`: project, list, blend; of `backward`: blend_backward, gather, unproject."""

    def __init__(self, camera: Camera, stopwatch: Stopwatch | None = None) -> None:
        self.camera, self.stopwatch, self._tiling = camera, stopwatch, Tiling.of(camera)
        self._intrinsics = runtime.to_device(camera.intrinsics)
        self._pixels = _pixels_of_chunks()
        self._g = runtime.zeros((self._tiling.count * CHUNKS, rasterize.G, LANES), lanes=True)
        self._absent = AbsentGradient.of_size(camera.height, camera.width)
        self._slots = _SlotBuffers(1 << 15, self._tiling.count)
        self._splats = _SplatBuffers(1)
        self._tiles = _TileBuffers(self._tiling)
        self.slot_count = 0

    @property
    def tile_count(self) -> np.ndarray:
        """[capacity] int32 device array: tiles that each Gaussian touched in the last `forward`."""
        return self._splats.tile_count

    @property
    def pair_count(self) -> int:
        """(splat, pixel) pairs that the last `forward` blended, in whole chunks: `backward` takes the same ones."""
        mask = runtime.to_host(self._slots.mask)[: self.slot_count]
        return LANES * int(np.bitwise_count(mask.view(np.uint32)).sum())

    def forward(self, gaussians: Splats, pose: np.ndarray, with_embedding: bool, images: RenderImages) -> None:
        """Render into `images`. pose: device array [12], rows of [R | t] of T_cw."""
        with stage(self.stopwatch, "project"):
            self._project(gaussians, pose, with_embedding)
        with stage(self.stopwatch, "list"):
            slots = self._list_slots(gaussians.count)
        with stage(self.stopwatch, "blend"):
            rasterize.forward(
                self._tiling.count, self._tiling.across, self._tiles.start, slots.ids, self._splats.splat,
                slots.slot, slots.slot, slots.mask, slots.groups, slots.groups, self._pixels, with_embedding,
                images.colour, images.depth, images.opacity, images.embedding,
            )  # fmt: skip

    def backward(
        self, gaussians: Splats, pose: np.ndarray, images: RenderImages, g: ImageGradient, into: MapGradient
    ) -> NDArray[np.float64]:
        """Add the gradients of the last `forward` to `into`; returns the pose's [6]."""
        curvature = g.colour_weight is not None and g.depth_weight is not None
        embedding = g.embedding is not None
        slots, splats, absent, n = self._slots, self._splats, self._absent, gaussians.count
        with stage(self.stopwatch, "blend_backward"):
            rasterize.backward(
                self._tiling.count, self._tiling.across, self._tiles.start, slots.slot, slots.mask, slots.entry,
                embedding, curvature,
                images.colour, images.depth, images.opacity, images.embedding,
                g.colour, g.depth, g.opacity, g.embedding if embedding else absent.embedding,
                g.colour_weight if curvature else absent.weight, g.depth_weight if curvature else absent.weight,
                self._pixels, self._g, slots.grad, slots.embedding_grad,
            )  # fmt: skip
        with stage(self.stopwatch, "gather"):
            rasterize.gather_gradients(
                n, splats.tile_count, splats.first_of, embedding, slots.grad, slots.embedding_grad, splats.moments
            )
        with stage(self.stopwatch, "unproject"):
            blocks = runtime.zeros((max(1, -(-n // projection_gradient.POSE_BLOCK)), 6))
            projection_gradient.project_backward(
                n, gaussians.mean, gaussians.log_scale, gaussians.quat_wxyz, gaussians.opacity_logit,
                splats.splat, pose, self._intrinsics, self.camera.width, self.camera.height, embedding,
                splats.tile_count, splats.moments.reshape(splats.capacity, -1),
                into.mean, into.log_scale, into.quat_wxyz, into.opacity_logit, into.colour, into.embedding,
                into.curvature, blocks,
            )  # fmt: skip
            return runtime.to_host(blocks).sum(0, dtype=np.float64)

    def _project(self, gaussians: Splats, pose: np.ndarray, with_embedding: bool) -> None:
        """Splat rows, and the tiles that each Gaussian touches."""
        if self._splats.capacity < gaussians.capacity:
            self._splats = _SplatBuffers(gaussians.capacity)
        splats = self._splats
        projection.project(
            gaussians.count, gaussians.mean, gaussians.log_scale, gaussians.quat_wxyz, gaussians.opacity_logit,
            gaussians.colour, gaussians.embedding, pose, self._intrinsics, self.camera.width, self.camera.height,
            with_embedding, splats.splat, splats.tile_rect, splats.tile_count,
        )  # fmt: skip

    def _list_slots(self, count: int) -> _SlotBuffers:
        """List each tile's splats in depth order (equal depths by index)."""
        splats, tiles = self._splats, self._tiles
        tile_count = runtime.to_host(splats.tile_count)[:count]
        ends = np.cumsum(tile_count, dtype=np.int32)
        self.slot_count = int(ends[-1]) if count else 0
        if self.slot_count > self._slots.capacity:
            self._slots = _SlotBuffers(max(2 * self._slots.capacity, self.slot_count), self._tiling.count)
        np.subtract(ends, tile_count, out=splats.first_of[:count])
        visible = np.flatnonzero(tile_count)
        order = _depth_order(runtime.to_host(splats.splat)[visible, projection.Z], visible)
        rasterize.count_slots(
            len(order), order, splats.tile_rect, splats.first_of, self._tiling.across, splats.by_depth, tiles.splats
        )
        per_tile = tiles.splats[:, : self._tiling.count]
        cursor = np.cumsum(per_tile, 0, dtype=np.int32)
        np.cumsum(cursor[-1], out=tiles.start[1:])
        cursor += tiles.start[:-1] - per_tile
        rasterize.fill_slots(
            len(order), order, splats.by_depth, self._tiling.across, cursor, self._slots.ids, self._slots.entry
        )
        return self._slots


def _depth_order(depth_m: NDArray[np.float32], index: NDArray[np.intp]) -> NDArray[np.int32]:
    """`index` sorted by (depth, index): positive floats order like their bits, so one integer sort does both."""
    keys = (depth_m.view(np.uint32).astype(np.int64) << 32) | index
    keys.sort()
    return (keys & 0xFFFFFFFF).astype(np.int32)


def _pixels_of_chunks() -> np.ndarray:
    """[CHUNKS, 2, LANES] px: x and y of each chunk's pixels in its tile."""
    y, x = np.mgrid[:TILE, :TILE].reshape(2, PER_ROW, CHUNK, PER_ROW, CHUNK).swapaxes(2, 3)
    pixels = runtime.empty((CHUNKS, 2, LANES), lanes=True)
    pixels[:] = np.stack([x.reshape(CHUNKS, LANES), y.reshape(CHUNKS, LANES)], 1)
    return pixels
