"""The objective linearised about a pose: J^T W J, J^T W r, and what goes with them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.map_settings import LossConfig
from tgslam.config.tracking_settings import ResidualSettings
from tgslam.geometry import adjoint
from tgslam.ops.alignment import NormalSums, layout
from tgslam.tracking.exposure import IntensityMoments
from tgslam.tracking.pyramid import LiveLevel, ModelLevel
from tgslam.types import Exposure

_UPPER = np.triu_indices(layout.UNKNOWNS)


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


class Lineariser:
    """Evaluates Eqs. 12, 13 (without SSIM) between one resolution of a frame and of the model; holds the scratch."""

    def __init__(self, camera: Camera, config: ResidualSettings, loss: LossConfig) -> None:
        self._config = config
        self._settings = np.zeros(layout.SETTINGS, np.float32)
        for entry, value in {
            layout.FX: camera.fx,
            layout.FY: camera.fy,
            layout.CX: camera.cx,
            layout.CY: camera.cy,
            layout.DEPTH_SIGMA: loss.noise.per_m2,
            layout.MAX_DISTANCE_SIGMAS: config.max_distance_sigmas,
            layout.CHARBONNIER_DEPTH: loss.expert.penalties.charbonnier_depth_sigmas,
            layout.GATE_DEPTH_BOOST: loss.expert.texture.gate_depth_boost,
            layout.SIGMA_COLOUR: config.sigma_colour,
            layout.SIGMA_GRADIENT: config.sigma_gradient,
            layout.SURFACE_SIGMA: config.surface_sigma_m,
        }.items():
            self._settings[entry] = value
        self._add_up = NormalSums(camera)

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
        settings[layout.WEIGHT_DEPTH] = 0.0 if backed else config.weight_depth
        settings[layout.WEIGHT_COLOUR] = colour_share * config.weight_colour
        settings[layout.WEIGHT_GRADIENT] = colour_share * config.weight_gradient
        settings[layout.GAIN], settings[layout.BIAS] = exposure.gain, exposure.bias
        settings[layout.LIVE_SHARE] = 0.5 if model.measured else 0.0
        settings[layout.GATE_LOW] = live.gate_low
        settings[layout.GATE_INVERSE_RANGE] = live.gate_inverse_range
        settings[layout.POSE :] = T_ml[:3].reshape(12)
        return self._add_up(settings, live.pixels, model.surface, model.texture)

    def _unpacked(self, sums: NDArray[np.float64]) -> NormalEquations:
        A = np.zeros((layout.UNKNOWNS, layout.UNKNOWNS))
        A[_UPPER] = A.T[_UPPER] = sums[: layout.TRIANGLE]
        named = sums.tolist()
        matched = max(named[layout.MATCHED], 1.0)
        return NormalEquations(
            A=A,
            b=sums[layout.RHS : layout.RHS + layout.UNKNOWNS],
            live_pixels=named[layout.LIVE_PIXELS],
            candidates=named[layout.CANDIDATES],
            matched=named[layout.MATCHED],
            inliers=named[layout.INLIERS],
            depth_residual=named[layout.DEPTH_SUM] / matched,
            colour_residual=named[layout.COLOUR_SUM] / max(named[layout.SHOWN], 1.0) * self._config.sigma_colour,
            intensity=IntensityMoments(*named[layout.W : layout.W_LM + 1]),
        )
