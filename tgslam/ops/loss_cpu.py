"""The objective on the CPU: 16 pixels of a row at a time."""

from __future__ import annotations

import numpy as np

from tgslam.config.map_settings import LossConfig
from tgslam.device import runtime
from tgslam.kernels import loss as kernels
from tgslam.kernels.objective import MOMENTS, SLOPES, STRUCTURE, TOTALS
from tgslam.kernels.simd import LANES
from tgslam.ops.loss_images import LossImages, PreparedObservation

_ALIGNMENT = 64  # bytes, see `runtime.empty`


def observe(colour: np.ndarray, depth: np.ndarray, mask: np.ndarray, gate: np.ndarray) -> PreparedObservation:
    """Prepare an observation from images [H, W, 3] and [H, W], as rows of B = ceil(W / 16) blocks of lanes.

    Colour is [H, 3 B, 16] with interleaved channels, statistics are [H, B, 2, 16], the rest is [H, B, 16].
    """
    height, width = depth.shape
    blocks = _blocks(width)
    result = PreparedObservation(
        colour=in_lanes(colour),
        depth=in_lanes(depth),
        mask=in_lanes(mask),
        gate=in_lanes(gate),
        luma=runtime.empty((height, blocks, LANES)),
        texture=runtime.empty((height, blocks, LANES)),
        statistics=runtime.zeros((height, blocks, 2, LANES)),
    )
    kernels.observe_luma(width, result.colour, result.gate, result.luma, result.texture)
    column = runtime.zeros((height, blocks + 2, MOMENTS, LANES))
    kernels.observe_statistics(result.luma, column, result.statistics)
    return result


class CpuObjective:
    """Scratch memory and passes for images of one size."""

    def __init__(self, height: int, width: int) -> None:
        blocks = _blocks(width)
        self.width = width
        self._x = runtime.empty((height, blocks, LANES))
        self._weight = runtime.empty((height, blocks, LANES))
        # Zero beyond the image and in the border rows, where kernels never write
        self._column = runtime.zeros((height, blocks + 2, MOMENTS, LANES))
        self._slope = runtime.zeros((height, blocks + 2, SLOPES, LANES))
        self._field = runtime.zeros((height, blocks, SLOPES, LANES))
        self._partial = runtime.zeros((height, TOTALS))
        self._result = LossImages(
            colour=runtime.empty((height, 3 * blocks, LANES)),
            depth=runtime.empty((height, blocks, LANES)),
            opacity=runtime.empty((height, blocks, LANES)),
            w_colour=runtime.empty((height, blocks, LANES)),
            w_depth=runtime.empty((height, blocks, LANES)),
            totals=runtime.empty((TOTALS,)),
        )  # as rows of lanes

    def evaluate(
        self,
        colour: np.ndarray,
        depth: np.ndarray,
        opacity: np.ndarray,
        observation: PreparedObservation,
        config: LossConfig,
        gain: float,
        bias: float,
        min_opacity: float,
    ) -> LossImages:
        """See `losses.rgbd_loss`."""
        colour, depth, opacity = in_lanes(colour), in_lanes(depth), in_lanes(opacity)
        result, texture, penalties = self._result, config.expert.texture, config.expert.penalties
        kernels.mix(
            self.width, colour, opacity, observation.depth, observation.mask, observation.luma, observation.texture,
            gain, bias, min_opacity, penalties.min_depth_opacity, self._x, self._weight, self._partial,
        )  # fmt: skip
        kernels.structure(
            self._x, observation.luma, observation.statistics, self._weight, penalties.charbonnier_grad,
            self._column, self._slope, self._field, self._partial,
        )  # fmt: skip
        kernels.add_partials(self._partial, 0, STRUCTURE, result.totals)
        kernels.gradient(
            colour, depth, opacity, observation.colour, observation.depth, observation.mask, observation.gate,
            self._x, observation.luma, self._field, result.totals,
            gain, bias, min_opacity, penalties.min_depth_opacity,
            penalties.charbonnier_colour, penalties.charbonnier_depth_sigmas, texture.gate_depth_boost,
            config.noise.per_m2, config.weight_pho * config.weight_l1, config.weight_pho * config.weight_grad,
            config.weight_pho * config.weight_ssim, config.weight_geo,
            result.colour, result.depth, result.opacity, result.w_colour, result.w_depth, self._partial,
        )  # fmt: skip
        kernels.add_partials(self._partial, STRUCTURE, TOTALS, result.totals)
        return LossImages(
            self._image(result.colour, 3),
            self._image(result.depth),
            self._image(result.opacity),
            self._image(result.w_colour),
            self._image(result.w_depth),
            result.totals,
        )

    def _image(self, lanes: np.ndarray, channels: int = 1) -> np.ndarray:
        """[H, W] or [H, W, channels]: the same memory where the width is a multiple of 16, else a copy."""
        height = lanes.shape[0]
        rows = np.ascontiguousarray(lanes.reshape(height, -1)[:, : self.width * channels])
        return rows.reshape(height, self.width, channels) if channels > 1 else rows


def in_lanes(image: np.ndarray) -> np.ndarray:
    """[H, W] or [H, W, 3] as rows of 16 values: the same memory where that can be, else a copy padded with zeros."""
    height, width, *channels = image.shape
    if width % LANES == 0 and image.ctypes.data % _ALIGNMENT == 0:
        return image.reshape(height, -1, LANES)
    values = width * (channels[0] if channels else 1)
    padded = runtime.zeros((height, _blocks(width) * LANES * values // width))
    padded[:, :values] = image.reshape(height, values)
    return padded.reshape(height, -1, LANES)


def _blocks(width: int) -> int:
    return -(-width // LANES)
