"""The adaptive RGB-depth objective, Eqs. 10-14: its value and its gradient by the rendered images, gain and bias."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tgslam import images, runtime
from tgslam.arrays import require
from tgslam.config.schema import LossConfig
from tgslam.kernels import loss as kernels


@dataclass(frozen=True)
class Observation:
    """A keyframe's side of the objective, as device arrays, prepared once by `observe`. B = ceil(W / 16) lane blocks.

    The gradient term is linear before its penalty, so it needs no gradients of the observation, only its luminance.
    """

    colour: np.ndarray  # [H, W, 3] RGB
    depth_m: np.ndarray  # [H, W] 0 = none
    mask: np.ndarray  # [H, W] M_rgb in [0, 1]
    gate: np.ndarray  # [H, W] T of Eq. 11
    luma: np.ndarray  # [H, B, 16]
    texture: np.ndarray  # [H, B, 16] 1 - T, 0 in the border of 5 px
    statistics: np.ndarray  # [H, B, 2, 16] windowed mean and variance of luma

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self.depth_m.shape
        return height, width


@dataclass(frozen=True)
class LossResult:
    """The objective at one rendering. With a shared `Workspace`, the arrays are overwritten by its next use."""

    value: float  # weight_pho E_pho + weight_geo E_geo
    parts: dict[str, float]  # means before weighting: l1, grad, ssim, geo; pixels counted: pixels, depths
    g_colour: np.ndarray  # [H, W, 3] derivative by rendered colour
    g_depth: np.ndarray  # [H, W] by accumulated depth, 1/m
    g_opacity: np.ndarray  # [H, W] by accumulated opacity
    g_gain: float
    g_bias: float
    w_colour: np.ndarray  # [H, W] curvature of the intensity term by a rendered channel (reweighted least squares)
    w_depth: np.ndarray  # [H, W] curvature of E_geo by accumulated depth, 1/m^2


class Workspace:
    """Scratch and output arrays for one image size; pass it on to save their allocation in a loop."""

    def __init__(self, height: int, width: int) -> None:
        blocks = -(-width // kernels.LANES)
        self.size = (height, width)
        self.x = _lanes(height, blocks)
        self.weight = _lanes(height, blocks)
        self.by_luma = _lanes(height, blocks)
        self.flow = _lanes(height, blocks, 2)
        self.field = _lanes(height, blocks, 3)
        self.blurred = _lanes(height, blocks, 3)
        self.g_colour = runtime.empty((height, width, 3))
        self.g_depth = runtime.empty((height, width))
        self.g_opacity = runtime.empty((height, width))
        self.w_colour = runtime.empty((height, width))
        self.w_depth = runtime.empty((height, width))
        self.sums1 = runtime.empty((height * kernels.SPLIT, 1))
        self.sums3 = runtime.empty((height * kernels.SPLIT, 3))


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
    gate = images.texture_gate(images.luminance(colour), config.gate_percentile, config.gate_noise_floor)
    blocks = -(-width // kernels.LANES)
    luma, texture = _lanes(height, blocks), _lanes(height, blocks)
    kernels.pack_luminance(colour, luma)
    kernels.pack_texture(gate, texture)
    field, statistics = _lanes(height, blocks, 2), _lanes(height, blocks, 2)
    kernels.blur_luma(luma, field)
    kernels.luma_statistics(field, statistics)
    return Observation(colour, depth_m, mask, gate, luma, texture, statistics)


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
    config.min_depth_opacity. min_opacity: pixels of less opacity take no part in E_pho (tracking against a map with
    holes); masks are constants to the gradient. Each part is a mean over its pixels:

    - l1: Charbonnier over the three channels, M_rgb;
    - grad: Charbonnier on the length of the Sobel gradient difference of luminance, times 1 - T, M_rgb;
    - ssim: 1 - SSIM of luminance, 11x11 Gaussian window (sigma 1.5), times 1 - T, M_rgb;
    - geo: Charbonnier on (depth - measured) / (sigma_per_m2 measured^2), times 1 + gate_depth_boost T, M_d.

    grad and ssim leave out the border of 5 px; where M_rgb < 1 they see the observation mixed in by 1 - M_rgb.
    """
    height, width = observation.size
    require("colour", colour, (height, width, 3))
    require("depth", depth, (height, width))
    require("opacity", opacity, (height, width))
    work = workspace or Workspace(height, width)
    if work.size != (height, width):
        raise ValueError(f"the workspace is for images of {list(work.size)} pixels, not {[height, width]}")
    kernels.mix(
        colour, opacity, observation.depth_m, observation.mask, observation.luma, observation.texture,
        gain, bias, min_opacity, config.min_depth_opacity, work.x, work.weight, work.sums3,
    )  # fmt: skip
    pixels, inner, depths = _totals(work.sums3)
    per_pixel, per_inner, per_depth = (1.0 / n if n > 0 else 0.0 for n in (3.0 * pixels, inner, depths))
    ssim, grad = _structure(observation, config, per_inner, work)
    kernels.colour_gradient(
        colour, observation.colour, opacity, observation.mask, work.by_luma, gain, bias, min_opacity,
        config.charbonnier_colour, config.weight_pho * config.weight_l1 * per_pixel, work.g_colour, work.w_colour,
        work.sums3,
    )  # fmt: skip
    l1, g_gain, g_bias = _totals(work.sums3)
    kernels.depth_gradient(
        depth, opacity, observation.depth_m, observation.gate, config.gate_depth_boost, config.depth_sigma_per_m2,
        config.charbonnier_depth_sigmas, config.min_depth_opacity, config.weight_geo * per_depth,
        work.g_depth, work.g_opacity, work.w_depth, work.sums1,
    )  # fmt: skip
    (geo,) = _totals(work.sums1)
    parts = {"l1": l1 * per_pixel, "grad": grad * per_inner, "ssim": ssim * per_inner, "geo": geo * per_depth}
    photometric = (
        config.weight_l1 * parts["l1"] + config.weight_grad * parts["grad"] + config.weight_ssim * parts["ssim"]
    )
    value = config.weight_pho * photometric + config.weight_geo * parts["geo"]
    parts |= {"pixels": pixels, "depths": depths}
    return LossResult(
        value, parts, work.g_colour, work.g_depth, work.g_opacity, g_gain, g_bias, work.w_colour, work.w_depth
    )


def _structure(observation: Observation, config: LossConfig, per_inner: float, work: Workspace) -> tuple[float, float]:
    """Weighted sums of 1 - SSIM and of the gradient penalty; leaves their derivative by luminance in the workspace."""
    kernels.blur_moments(work.x, observation.luma, work.field)
    kernels.ssim(work.field, observation.statistics, work.weight, work.blurred, work.sums1)
    (ssim,) = _totals(work.sums1)
    kernels.blur_rows(work.blurred, work.field)
    kernels.sobel_flow(work.x, observation.luma, work.weight, config.charbonnier_grad, work.flow, work.sums1)
    (grad,) = _totals(work.sums1)
    scale = config.weight_pho * per_inner
    kernels.luma_gradient(
        work.x, observation.luma, work.field, work.flow, scale * config.weight_ssim, scale * config.weight_grad,
        work.by_luma,
    )  # fmt: skip
    return ssim, grad


def _lanes(*shape: int) -> np.ndarray:
    return runtime.empty((*shape, kernels.LANES), lanes=True)


def _totals(sums: np.ndarray) -> list[float]:
    """Column sums of the kernels' partial sums, in float64 and in a fixed order."""
    return [float(total) for total in runtime.to_host(sums).sum(axis=0, dtype=np.float64)]
