"""Splatting on a CUDA device: the stages round its kernels, and their scratch memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.device.stopwatch import Stopwatch, stage
from tgslam.kernels import projection, projection_gradient
from tgslam.kernels.cuda import rasterize, scan
from tgslam.kernels.cuda.block import WARPS
from tgslam.kernels.warp import WARP
from tgslam.ops.render_images import AbsentGradient, ImageGradient, RenderImages
from tgslam.ops.sort import Pairs, PrefixSums, RadixSort
from tgslam.ops.splats import MapGradient, Splats
from tgslam.ops.tiles import Tiling


class _SplatBuffers:
    """Scratch for one entry per Gaussian, grown with the map's capacity."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.splat = runtime.empty((capacity, projection.SPLAT))
        self.moments = runtime.empty((capacity, projection.MOMENTS))
        self.tile_rect = runtime.empty((capacity, 4), np.int32)
        self.tile_count = runtime.zeros((capacity,), np.int32)
        self.by_depth = Pairs(capacity)  # depth bits, Gaussian
        self.first_of = runtime.empty((capacity + 1,), np.int32)  # in depth order
        self.pose_rows = runtime.empty((max(1, -(-capacity // projection_gradient.POSE_BLOCK)), 6))


class _SlotBuffers(Pairs):
    """Scratch for one entry per (splat, tile), grown by doubling: pairs of tile and Gaussian."""

    def __init__(self, capacity: int) -> None:
        super().__init__(capacity)
        self.reached = runtime.empty((capacity,), np.int32)


class _TileBuffers:
    """Scratch for one entry per tile."""

    def __init__(self, tiles: int) -> None:
        self.start = runtime.zeros((tiles + 1,), np.int32)  # first slot of each, and the end of the last
        self.stop = runtime.zeros((tiles, WARPS), np.int32)  # where each warp has ended


class CudaSplatting:
    """Stages of `forward`: project, list, blend; of `backward`: blend_backward, unproject.

    The host waits for the device twice: for the number of slots, which says how many threads to launch and whether the
    buffers are large enough, and for the pose's gradient.
    """

    def __init__(self, camera: Camera, stopwatch: Stopwatch | None = None) -> None:
        self.camera, self.stopwatch, self._tiling = camera, stopwatch, Tiling.of(camera)
        self._intrinsics = runtime.to_device(camera.intrinsics)
        self._tiles = _TileBuffers(self._tiling.count)
        self._absent = AbsentGradient.of_size(1, 1)
        self._pose_gradient = runtime.zeros((6,))
        self._sort, self._prefix_sums = RadixSort(), PrefixSums()
        self._slots = _SlotBuffers(1 << 15)
        self._splats = _SplatBuffers(1)
        self.slot_count = 0

    @property
    def tile_count(self) -> np.ndarray:
        """[capacity] int32 device array: tiles that each Gaussian touched in the last `forward`."""
        return self._splats.tile_count

    @property
    def pair_count(self) -> int:
        """(splat, pixel) pairs that the last `forward` blended, in whole warps: `backward` takes the same ones."""
        return WARP * int(
            rasterize.count_passes(self.slot_count, self._slots.keys, self._slots.reached, self._tiles.stop)
        )

    def forward(self, gaussians: Splats, pose: np.ndarray, with_embedding: bool, images: RenderImages) -> None:
        """Render into `images`. pose: device array [12], rows of [R | t] of T_cw."""
        with stage(self.stopwatch, "project"):
            self._project(gaussians, pose, with_embedding)
        with stage(self.stopwatch, "list"):
            slots = self._list_slots(gaussians.count)
        tiles = self._tiles
        with stage(self.stopwatch, "blend"):
            rasterize.forward(
                self._tiling.count, self._tiling.across, tiles.start, slots.values, slots.reached, self._splats.splat,
                with_embedding, tiles.stop, images.colour, images.depth, images.opacity, images.embedding,
            )  # fmt: skip

    def backward(
        self, gaussians: Splats, pose: np.ndarray, images: RenderImages, g: ImageGradient, into: MapGradient
    ) -> NDArray[np.float64]:
        """Add the gradients of the last `forward` to `into`; returns the pose's [6]."""
        curvature = g.colour_weight is not None and g.depth_weight is not None
        embedding = g.embedding is not None
        splats, slots, tiles, absent = self._splats, self._slots, self._tiles, self._absent
        with stage(self.stopwatch, "blend_backward"):
            splats.moments.fill(0)
            rasterize.backward(
                self._tiling.count, self._tiling.across, tiles.start, slots.values, slots.reached, splats.splat,
                tiles.stop,
                embedding, curvature, images.colour, images.depth, images.opacity, images.embedding,
                g.colour, g.depth, g.opacity, g.embedding if embedding else absent.embedding,
                g.colour_weight if curvature else absent.weight, g.depth_weight if curvature else absent.weight,
                splats.moments,
            )  # fmt: skip
        with stage(self.stopwatch, "unproject"):
            projection_gradient.project_backward(
                gaussians.count, gaussians.mean, gaussians.log_scale, gaussians.quat_wxyz, gaussians.opacity_logit,
                splats.splat, pose, self._intrinsics, self.camera.width, self.camera.height, embedding,
                splats.tile_count, splats.moments, into.mean, into.log_scale, into.quat_wxyz, into.opacity_logit,
                into.colour, into.embedding, into.curvature, splats.pose_rows,
            )  # fmt: skip
            return np.array(scan.sum_rows(splats.pose_rows, self._pose_gradient), np.float64)

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
        splats, order = self._splats, self._splats.by_depth
        rasterize.depth_keys(count, splats.tile_count, splats.splat, order.keys, order.values)
        self._sort(order, count, rasterize.DEPTH_BITS)
        self.slot_count = self._prefix_sums(splats.tile_count, order.values, count, splats.first_of)
        if self.slot_count > self._slots.capacity:
            self._slots = _SlotBuffers(max(2 * self._slots.capacity, self.slot_count))
        slots = self._slots
        rasterize.list_slots(
            self.slot_count, count, order.values, splats.first_of, splats.tile_rect, self._tiling.across,
            slots.keys, slots.values,
        )  # fmt: skip
        self._sort(slots, self.slot_count, (self._tiling.count - 1).bit_length())
        rasterize.find_starts(self.slot_count, self._tiling.count, slots.keys, self._tiles.start)
        rasterize.find_reach(
            self.slot_count, self._tiling.across, slots.keys, slots.values, splats.splat, slots.reached
        )
        return slots
