"""The objective linearised about a pose: J^T W J, J^T W r, and what goes with them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tgslam import runtime
from tgslam.config.schema import LossConfig, TrackingConfig
from tgslam.geometry import adjoint
from tgslam.kernels import alignment
from tgslam.kernels.cuda import alignment as cuda
from tgslam.tracking.exposure import Exposure, IntensityMoments
from tgslam.tracking.pyramid import LiveLevel, ModelLevel
from tgslam.types import Camera

_UPPER = np.triu_indices(alignment.UNKNOWNS)


@dataclass(frozen=True)
class NormalEquations:
    """J^T W J, J^T W r and the statistics of one evaluation."""

    A: NDArray[np.float64]  # [6, 6]
    b: NDArray[np.float64]  # [6]
    live_pixels: float  # with depth
    candidates: float  # of them, those that meet a model pixel
    matched: float  # of them, with depths that agree roughly
    inliers: float  # of them, within three sigma
    depth_residual: float  # mean, in sigmas
    colour_residual: float  # mean, in intensity
    intensity: IntensityMoments

    def joined(self, other: NormalEquations, T_om: NDArray[np.float64]) -> NormalEquations:
        """With those of another model, whose camera is T_om [4, 4] from this one's; the statistics are this one's.

        But colours have to fit both: their residual is the larger one, if the other matches at least half as much.
        """
        moved = adjoint(T_om)
        counts = other.matched >= 0.5 * self.matched
        return replace(
            self,
            A=self.A + moved.T @ other.A @ moved,
            b=self.b + moved.T @ other.b,
            colour_residual=max(self.colour_residual, other.colour_residual if counts else 0.0),
        )


class _Kernels(Protocol):
    """How a device evaluates the sums."""

    def sums(self, settings: np.ndarray, live: LiveLevel, model: ModelLevel) -> NDArray[np.float64]:
        """The sums [SUMS] over all pixels, in the order of `kernels.alignment`."""
        ...


class _CpuKernels:
    """16 pixels at a time; the parts' sums are added here, in float64."""

    def __init__(self, camera: Camera) -> None:
        parts = alignment.parts(camera.height)
        self._scratch = runtime.empty((parts, alignment.PADDED_SUMS, alignment.LANES), lanes=True)
        self._packed = runtime.empty((parts, alignment.PACKED_SUMS, alignment.LANES), lanes=True)

    def sums(self, settings: np.ndarray, live: LiveLevel, model: ModelLevel) -> NDArray[np.float64]:
        alignment.normal_equations(settings, live.pixels, model.surface, model.texture, self._scratch, self._packed)
        return self._packed.reshape(len(self._packed), -1)[:, : alignment.SUMS].sum(0, dtype=np.float64)


class _CudaKernels:
    """A pixel a thread; only the totals come to the host."""

    def __init__(self, camera: Camera) -> None:
        self._by_warp = runtime.empty((cuda.warps(camera.width * camera.height), alignment.SUMS))
        self._totals = runtime.empty((alignment.SUMS,))

    def sums(self, settings: np.ndarray, live: LiveLevel, model: ModelLevel) -> NDArray[np.float64]:
        cuda.add_pixels(settings, live.pixels, model.surface, model.texture, self._by_warp)
        cuda.add_warps(self._by_warp, self._totals)
        return runtime.to_host(self._totals).astype(np.float64)


class Lineariser:
    """Evaluates Eqs. 12, 13 (without SSIM) between one resolution of a frame and of the model; holds the scratch."""

    def __init__(self, camera: Camera, config: TrackingConfig, loss: LossConfig) -> None:
        self._config = config
        self._settings = np.zeros(alignment.SETTINGS, np.float32)
        for entry, value in {
            alignment.FX: camera.fx,
            alignment.FY: camera.fy,
            alignment.CX: camera.cx,
            alignment.CY: camera.cy,
            alignment.DEPTH_SIGMA: loss.depth_sigma_per_m2,
            alignment.MAX_DISTANCE_SIGMAS: config.max_distance_sigmas,
            alignment.CHARBONNIER_DEPTH: loss.charbonnier_depth_sigmas,
            alignment.GATE_DEPTH_BOOST: loss.gate_depth_boost,
            alignment.SIGMA_COLOUR: config.sigma_colour,
            alignment.SIGMA_GRADIENT: config.sigma_gradient,
            alignment.SURFACE_SIGMA: config.surface_sigma_m,
        }.items():
            self._settings[entry] = value
        self._on_device = runtime.empty(self._settings.shape)
        on_cuda = runtime.device() is runtime.Device.CUDA
        self._kernels: _Kernels = _CudaKernels(camera) if on_cuda else _CpuKernels(camera)

    def __call__(
        self,
        live: LiveLevel,
        model: ModelLevel,
        T_ml: NDArray[np.float64],
        exposure: Exposure,
        *,
        backed: bool = False,
    ) -> NormalEquations:
        """The equations at T_ml [4, 4] (live camera to model camera) and that exposure of the frame.

        The unknowns are a left perturbation of T_ml. backed: the model is a rendering, and references show the same.
        """
        return self._unpacked(self._sums(live, model, T_ml, exposure, backed))

    def _sums(
        self, live: LiveLevel, model: ModelLevel, T_ml: NDArray[np.float64], exposure: Exposure, backed: bool
    ) -> NDArray[np.float64]:
        """The sums [SUMS] over all pixels, in the kernel's order."""
        settings, config = self._settings, self._config
        colour_share = config.splatted_colour if backed else 1.0
        settings[alignment.WEIGHT_DEPTH] = 0.0 if backed else config.weight_depth
        settings[alignment.WEIGHT_COLOUR] = colour_share * config.weight_colour
        settings[alignment.WEIGHT_GRADIENT] = colour_share * config.weight_gradient
        settings[alignment.GAIN], settings[alignment.BIAS] = exposure.gain, exposure.bias
        settings[alignment.LIVE_SHARE] = 0.5 if model.measured else 0.0
        settings[alignment.GATE_LOW] = live.gate_low
        settings[alignment.GATE_INVERSE_RANGE] = live.gate_inverse_range
        settings[alignment.POSE :] = T_ml[:3].reshape(12)
        runtime.upload(settings, self._on_device)
        return self._kernels.sums(self._on_device, live, model)

    def _unpacked(self, sums: NDArray[np.float64]) -> NormalEquations:
        A = np.zeros((alignment.UNKNOWNS, alignment.UNKNOWNS))
        A[_UPPER] = A.T[_UPPER] = sums[: alignment.TRIANGLE]
        named = sums.tolist()
        matched = max(named[alignment.MATCHED], 1.0)
        return NormalEquations(
            A=A,
            b=sums[alignment.RHS : alignment.RHS + alignment.UNKNOWNS],
            live_pixels=named[alignment.LIVE_PIXELS],
            candidates=named[alignment.CANDIDATES],
            matched=named[alignment.MATCHED],
            inliers=named[alignment.INLIERS],
            depth_residual=named[alignment.DEPTH_SUM] / matched,
            colour_residual=named[alignment.COLOUR_SUM] / matched * self._config.sigma_colour,
            intensity=IntensityMoments(*named[alignment.W : alignment.W_LM + 1]),
        )
