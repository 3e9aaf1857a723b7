"""The objective under CUDA: a pixel a thread."""

from __future__ import annotations

import numpy as np

from tgslam.config.map_settings import LossConfig
from tgslam.device import runtime
from tgslam.kernels.cuda import loss as kernels
from tgslam.kernels.objective import MOMENTS, SLOPES, STRUCTURE, TOTALS
from tgslam.kernels.warp import WARP
from tgslam.ops.loss_images import LossImages, PreparedObservation


def observe(colour: np.ndarray, depth: np.ndarray, mask: np.ndarray, gate: np.ndarray) -> PreparedObservation:
    """Prepare an observation from images [H, W, 3] and [H, W]; statistics are [2, H, W]."""
    height, width = depth.shape
    threads = kernels.threads_for(height, width)
    result = PreparedObservation(
        colour=colour,
        depth=depth,
        mask=mask,
        gate=gate,
        luma=runtime.empty((height, width)),
        texture=runtime.empty((height, width)),
        statistics=runtime.zeros((2, height, width)),
    )
    kernels.observe_luma(threads, colour, gate, result.luma, result.texture)
    column = runtime.empty((MOMENTS, height, width))
    kernels.blur_columns(threads, result.luma, result.luma, column)
    kernels.observe_statistics(threads, column, result.statistics)
    return result


class CudaObjective:
    """Scratch memory and passes for images of one size."""

    def __init__(self, height: int, width: int) -> None:
        self._threads = kernels.threads_for(height, width)
        self._x, self._weight = runtime.empty((height, width)), runtime.empty((height, width))
        self._column = runtime.empty((MOMENTS, height, width))
        # Zero in the border, where kernels never write
        self._slope = runtime.zeros((SLOPES, height, width))
        self._field = runtime.zeros((SLOPES, height, width))
        self._partial = runtime.empty((TOTALS, self._threads // WARP))
        self._result = LossImages(
            colour=runtime.empty((height, width, 3)),
            depth=runtime.empty((height, width)),
            opacity=runtime.empty((height, width)),
            w_colour=runtime.empty((height, width)),
            w_depth=runtime.empty((height, width)),
            totals=runtime.empty((TOTALS,)),
        )

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
        threads, luma, result = self._threads, observation.luma, self._result
        texture, penalties = config.expert.texture, config.expert.penalties
        kernels.mix(
            threads, colour, opacity, observation.depth, observation.mask, luma, observation.texture,
            gain, bias, min_opacity, penalties.min_depth_opacity, self._x, self._weight, self._partial,
        )  # fmt: skip
        kernels.blur_columns(threads, self._x, luma, self._column)
        kernels.structure(
            threads, self._x, luma, self._column, observation.statistics, self._weight, penalties.charbonnier_grad,
            self._slope, self._partial,
        )  # fmt: skip
        kernels.adjoint_rows(threads, self._slope, self._field)
        kernels.add_partials(threads // WARP, self._partial, 0, STRUCTURE, result.totals)
        kernels.gradient(
            threads, colour, depth, opacity, observation.colour, observation.depth, observation.mask, observation.gate,
            self._x, luma, self._field, result.totals, gain, bias, min_opacity, penalties.min_depth_opacity,
            penalties.charbonnier_colour, penalties.charbonnier_depth_sigmas, texture.gate_depth_boost,
            config.noise.per_m2, config.weight_pho * config.weight_l1, config.weight_pho * config.weight_grad,
            config.weight_pho * config.weight_ssim, config.weight_geo,
            result.colour, result.depth, result.opacity, result.w_colour, result.w_depth, self._partial,
        )  # fmt: skip
        kernels.add_partials(threads // WARP, self._partial, STRUCTURE, TOTALS, result.totals)
        return result
