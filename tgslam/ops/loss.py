"""The adaptive RGB-depth objective, Eqs. 10-14: its value and its gradient by the rendered images, gain and bias."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from tgslam.config.map_settings import LossConfig
from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels.objective import BIAS, DEPTHS, GAIN, GEO, GRAD, INNER, L1, PIXELS, SSIM
from tgslam.ops import image as images
from tgslam.ops import loss_cpu as cpu
from tgslam.ops import loss_cuda as cuda
from tgslam.ops.loss_images import LossImages, PreparedObservation


@dataclass(frozen=True)
class Observation:
    """A keyframe's side of the objective, as device arrays, prepared once by `observe`.

    The gradient term is linear before its penalty, so it needs no gradients of the observation, only its luminance.
    """

    size: tuple[int, int]  # height and width in pixels
    gate: np.ndarray  # [H, W] T of Eq. 11; 0 without the gate
    prepared: PreparedObservation


@dataclass(frozen=True)
class LossResult:
    """The objective at one rendering. Its arrays are overwritten by the next use of the same `Workspace`.

    Numbers stay on the device until one of them is asked for, which copies them all, once.
    """

    config: LossConfig
    images: LossImages

    @property
    def g_colour(self) -> np.ndarray:
        """[H, W, 3] derivative by rendered colour."""
        return self.images.colour

    @property
    def g_depth(self) -> np.ndarray:
        """[H, W] by accumulated depth, 1/m."""
        return self.images.depth

    @property
    def g_opacity(self) -> np.ndarray:
        """[H, W] by accumulated opacity."""
        return self.images.opacity

    @property
    def w_colour(self) -> np.ndarray:
        """[H, W] curvature of the intensity term by a rendered channel (reweighted least squares)."""
        return self.images.w_colour

    @property
    def w_depth(self) -> np.ndarray:
        """[H, W] curvature of E_geo by accumulated depth, 1/m^2."""
        return self.images.w_depth

    @property
    def totals(self) -> np.ndarray:
        """Device array of the sums over the image (kernels/objective.py), for kernels that go on from here."""
        return self.images.totals

    @cached_property
    def parts(self) -> dict[str, float]:
        """Means before weighting: l1, grad, ssim, geo; pixels counted: pixels, depths."""
        pixels, inner, depths = (self._sums[column] for column in (PIXELS, INNER, DEPTHS))
        return {
            "l1": _mean(self._sums[L1], 3.0 * pixels),
            "grad": _mean(self._sums[GRAD], inner),
            "ssim": _mean(self._sums[SSIM], inner),
            "geo": _mean(self._sums[GEO], depths),
            "pixels": pixels,
            "depths": depths,
        }

    @property
    def value(self) -> float:
        """weight_pho E_pho + weight_geo E_geo."""
        config, parts = self.config, self.parts
        photometric = (
            config.weight_l1 * parts["l1"] + config.weight_grad * parts["grad"] + config.weight_ssim * parts["ssim"]
        )
        return config.weight_pho * photometric + config.weight_geo * parts["geo"]

    @property
    def g_gain(self) -> float:
        """Derivative by the gain."""
        return self._sums[GAIN]

    @property
    def g_bias(self) -> float:
        """Derivative by the bias."""
        return self._sums[BIAS]

    @cached_property
    def _sums(self) -> list[float]:
        return [float(total) for total in runtime.to_host(self.images.totals)]


class _Passes(Protocol):
    """The kernels for images of one size on one device, with their scratch memory; arguments have been checked."""

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
        """See `rgbd_loss`."""
        ...


class Workspace:
    """Scratch and output arrays for one image size; pass it on to save their allocation in a loop."""

    def __init__(self, height: int, width: int) -> None:
        self.size = (height, width)
        on_cuda = runtime.device() is runtime.Device.CUDA
        self.passes: _Passes = (cuda.CudaObjective if on_cuda else cpu.CpuObjective)(height, width)


def observe(
    colour: np.ndarray,
    depth_m: np.ndarray,
    config: LossConfig,
    mask: np.ndarray | None = None,
) -> Observation:
    """Prepare an observation from device arrays.

    colour: float32 [H, W, 3] RGB in [0, 1]. depth_m: float32 [H, W], 0 = none. mask: float32 [H, W] weights in [0, 1]
    of the colour (M_rgb of Eq. 12), by default 1 everywhere. Raises ValueError for other shapes or dtypes.
    """
    height, width = require("colour", colour, (None, None, 3)).shape[:2]
    require("depth_m", depth_m, (height, width))
    if mask is None:
        mask = runtime.empty((height, width))
        mask.fill(1.0)
    require("mask", mask, (height, width))
    if config.gate:
        texture = config.expert.texture
        gate = images.texture_gate(images.luminance(colour), texture.gate_percentile, texture.gate_noise_floor)
    else:
        gate = runtime.zeros((height, width))
    prepare = cuda.observe if runtime.device() is runtime.Device.CUDA else cpu.observe
    return Observation((height, width), gate, prepare(colour, depth_m, mask, gate))


def rgbd_loss(
    colour: np.ndarray,
    depth: np.ndarray,
    opacity: np.ndarray,
    observation: Observation,
    config: LossConfig,
    gain: float = 1.0,
    bias: float = 0.0,
    min_opacity: float = 0.0,
    workspace: Workspace | None = None,
) -> LossResult:
    """Value and gradient of weight_pho E_pho + weight_geo E_geo (Eqs. 12, 13) at a rendering, as device arrays.

    colour: float32 [H, W, 3]; gain * colour + bias is compared. depth: float32 [H, W] accumulated sum of weight times
    depth, m. opacity: float32 [H, W]; depth / opacity is compared where there is a measurement and opacity exceeds
    `min_depth_opacity`. min_opacity: pixels of less opacity take no part in E_pho (tracking against a map with
    holes); masks are constants to the gradient. Each part is a mean over its pixels:

    - l1: Charbonnier over the three channels, M_rgb;
    - grad: Charbonnier on the length of the Sobel gradient difference of luminance, times 1 - T, M_rgb;
    - ssim: 1 - SSIM of luminance, 11x11 Gaussian window (sigma 1.5), times 1 - T, M_rgb;
    - geo: Charbonnier on (depth - measured) over the sensor's noise, times 1 + gate_depth_boost T, M_d.

    grad and ssim leave out the border of 5 px; where M_rgb < 1 they see the observation mixed in by 1 - M_rgb.
    """
    height, width = observation.size
    require("colour", colour, (height, width, 3))
    require("depth", depth, (height, width))
    require("opacity", opacity, (height, width))
    work = workspace or Workspace(height, width)
    if work.size != (height, width):
        raise ValueError(f"the workspace is for images of {list(work.size)} pixels, not {[height, width]}")
    gradients = work.passes.evaluate(colour, depth, opacity, observation.prepared, config, gain, bias, min_opacity)
    return LossResult(config, gradients)


def _mean(total: float, count: float) -> float:
    return total / count if count > 0 else 0.0
