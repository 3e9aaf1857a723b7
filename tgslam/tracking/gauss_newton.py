"""Gauss-Newton tracking: render the map once near the pose, align the frame to that image coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.map_settings import LossConfig
from tgslam.config.tracking_settings import TrackingConfig
from tgslam.device.stopwatch import Stopwatch, stage
from tgslam.geometry import adjoint, inverse, se3_exp, se3_log
from tgslam.map.gaussians import GaussianMap
from tgslam.ops.rasterize import Rasterizer
from tgslam.tracking.exposure import fit_exposure
from tgslam.tracking.linearisation import Lineariser, NormalEquations
from tgslam.tracking.lost import LostDetector
from tgslam.tracking.motion import unopposed
from tgslam.tracking.pyramid import (
    LiveLevel,
    LivePyramid,
    ModelLevel,
    ModelPyramid,
    ReferencePyramid,
    finest_level,
)
from tgslam.tracking.references import NO_PLANES, Reference
from tgslam.tracking.result import TrackingResult
from tgslam.types import Exposure, Frame

_CONVERGED = 1e-5  # rad and m: a smaller step ends a level
_DAMPING = 1e-6  # of the normal matrix's trace
_EXPOSURE_FITS = 3  # at a pose that is known: each weighs pixels anew
_BACKED = 0.5  # of the frame's pixels with depth match a reference: it shows what the map does


@dataclass
class _Match:
    """A keyframe to which a frame is being aligned."""

    levels: list[ModelLevel]
    T_rm: NDArray[np.float64]  # [4, 4] its camera from where the map was rendered
    exposure: Exposure  # of the frame, against its image

    @classmethod
    def of(
        cls, levels: list[ModelLevel], reference: Reference, T_mw: NDArray[np.float64], exposure: Exposure
    ) -> _Match:
        """exposure: of the frame, against the map."""
        return cls(levels, reference.T_cw @ inverse(T_mw), exposure.relative_to(reference.exposure))


class GaussNewtonTracker:
    """Minimises the RGB-depth objective over the pose and the frame's gain and bias."""

    def __init__(self, camera: Camera, config: TrackingConfig, loss: LossConfig) -> None:
        self.config = config
        self.stopwatch: Stopwatch | None = None
        self.detector = LostDetector(config.expert.lost)
        self.rasterizer = Rasterizer(camera)
        self._planes_w = NO_PLANES
        first, levels = finest_level(camera, config.finest_width_px), len(config.alignment_steps)
        self._live_pyramid = LivePyramid(camera, first, levels, loss)
        self._model_pyramid = ModelPyramid(camera, first, levels, loss.noise, config.expert.model)
        self._reference_pyramids = [
            ReferencePyramid(camera, first, levels, loss.noise) for _ in range(config.references)
        ]
        self._references: list[tuple[list[ModelLevel], Reference]] = []
        self._linearise = [
            Lineariser(level.camera, config.expert.residuals, loss) for level in self._live_pyramid.levels
        ]

    def know(self, planes_w: NDArray[np.float64], references: Sequence[Reference]) -> None:
        """See `Tracker.know`."""
        self._planes_w = planes_w
        self._references = [
            (pyramid.update(reference), reference)
            for pyramid, reference in zip(self._reference_pyramids, references, strict=False)
        ]

    def track(
        self,
        frame: Frame,
        gaussians: GaussianMap,
        T_cw: NDArray[np.float64],
        exposure: Exposure,
        prior: NDArray[np.float64] | None = None,
        *,
        firm: bool = False,
    ) -> TrackingResult:
        """See `Tracker.track`."""
        predicted, correlated_px = T_cw, self.config.expert.residuals.correlated_px
        prior = np.zeros((6, 6)) if prior is None else correlated_px * prior
        with stage(self.stopwatch, "pyramid"):
            live = self._live_pyramid.update(frame)
        for _ in range(self.config.expert.model.renders):
            model = self._model(gaussians, T_cw)
            with stage(self.stopwatch, "align"):
                T_ml, exposure, last = self._align(
                    live, model, T_cw, exposure, predicted @ inverse(T_cw), prior, firm=firm
                )
            T_cw = inverse(T_ml) @ T_cw
        return self._result(T_cw, T_ml, exposure, last)

    def accept(self, result: TrackingResult) -> None:
        """See `Tracker.accept`."""
        self.detector.accept(result.measures)

    def assess(
        self,
        frame: Frame,
        gaussians: GaussianMap,
        T_cw: NDArray[np.float64],
        exposure: Exposure,
        *,
        fits_exposure: bool = False,
    ) -> TrackingResult:
        """See `Tracker.assess`."""
        live, model = self._live_pyramid.update(frame)[0], self._model(gaussians, T_cw)[0]
        equations = self._linearise[0](live, model, np.eye(4), exposure)
        for _ in range(_EXPOSURE_FITS if fits_exposure else 0):
            exposure = fit_exposure(equations.intensity, self.config.exposure, exposure)
            equations = self._linearise[0](live, model, np.eye(4), exposure)
        return self._result(T_cw, np.eye(4), exposure, equations)

    def _result(
        self, T_cw: NDArray[np.float64], T_ml: NDArray[np.float64], exposure: Exposure, last: NormalEquations
    ) -> TrackingResult:
        information = adjoint(T_ml).T @ last.A @ adjoint(T_ml) / self.config.expert.residuals.correlated_px
        measures = {
            "inlier_ratio": last.inliers / max(last.matched, 1.0),
            "overlap": last.candidates / max(last.live_pixels, 1.0),
            "agreement": last.matched / max(last.candidates, 1.0),
            "depth_residual_sigmas": last.depth_residual,
            "colour_residual": last.colour_residual,
            "colour_residual_sigmas": last.colour_residual / self.config.expert.residuals.sigma_colour,
            "condition": float(np.linalg.cond(information)),
            "gain": exposure.gain,
            "bias": exposure.bias,
        }
        message = self.detector.judge(measures)
        return TrackingResult(T_cw, exposure, information, bool(message), message, measures)

    def _model(self, gaussians: GaussianMap, T_cw: NDArray[np.float64]) -> list[ModelLevel]:
        """Rendered at full size and halved like the frame.

        In a smaller image the rasterizer's low-pass filter widens the splats: near ones reach over edges, and the pose
        is drawn by millimetres.
        """
        with stage(self.stopwatch, "render"):
            rendered = self.rasterizer.forward(gaussians, T_cw)
        with stage(self.stopwatch, "pyramid"):
            return self._model_pyramid.update(rendered, self._planes_w @ inverse(T_cw))

    def _align(
        self,
        live: list[LiveLevel],
        model: list[ModelLevel],
        T_mw: NDArray[np.float64],
        exposure: Exposure,
        T_pm: NDArray[np.float64],
        prior: NDArray[np.float64],
        *,
        firm: bool,
    ) -> tuple[NDArray[np.float64], Exposure, NormalEquations]:
        """Coarse to fine from the identity; returns T_ml, the exposure, and the last equations.

        T_mw: world to where the model was rendered.
        T_pm: from where the model was rendered to the predicted camera, which `prior` [6, 6] draws the pose to, at the
        finest level. Coarser ones have fewer pixels to hold against it, so it counts as much less there. At either, it
        only speaks where the pixels do not, unless it is firm: then both count as they are, at every level.
        """
        T_ml = np.eye(4)
        matches = [_Match.of(levels, reference, T_mw, exposure) for levels, reference in self._references]
        for level in reversed(range(len(live))):
            for _ in range(self.config.alignment_steps[level]):
                others = [(self._of_reference(match, level, live[level], T_ml), match.T_rm) for match in matches]
                backed = any(other.matched >= _BACKED * other.live_pixels for other, _ in others)
                equations = self._linearise[level](live[level], model[level], T_ml, exposure, backed=backed)
                exposure = fit_exposure(equations.intensity, self.config.exposure, exposure)
                for other, T_rm in others:
                    equations = equations.joined(other, T_rm)
                # a weak damping holds the directions that nothing observes
                damping = _DAMPING * np.trace(equations.A) + 1e-9
                drawn = prior if firm else unopposed(prior / 4**level, equations.A)
                gradient = equations.b + drawn @ se3_log(T_pm @ T_ml)
                step = np.linalg.solve(equations.A + drawn + damping * np.eye(6), -gradient)
                T_ml = se3_exp(step) @ T_ml
                if np.abs(step).max() < _CONVERGED:
                    break
        return T_ml, exposure, equations

    def _of_reference(self, match: _Match, level: int, live: LiveLevel, T_ml: NDArray[np.float64]) -> NormalEquations:
        """Its exposure is fitted to its own image: by that of the map, a blank wall's shading would draw the camera."""
        equations = self._linearise[level](live, match.levels[level], match.T_rm @ T_ml, match.exposure)
        match.exposure = fit_exposure(equations.intensity, self.config.exposure, match.exposure)
        return equations
