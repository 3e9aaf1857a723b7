"""Gauss-Newton tracking: render the map once near the pose, align the frame to that image coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam import images, runtime
from tgslam.config.schema import LossConfig, TrackingConfig
from tgslam.gaussian_map import GaussianMap
from tgslam.geometry import adjoint, inverse, se3_exp
from tgslam.kernels import alignment
from tgslam.render import Rasterizer, RenderImages
from tgslam.stopwatch import Stopwatch, stage
from tgslam.tracking.exposure import Exposure, IntensityMoments, fit_exposure
from tgslam.tracking.lost import LostDetector
from tgslam.tracking.pyramid import LiveLevel, ModelLevel, finest_level, live_pyramid, model_pyramid
from tgslam.tracking.result import TrackingResult
from tgslam.types import Camera, Frame

_CONVERGED = 1e-5  # rad and m: a smaller step ends a level
_DAMPING = 1e-6  # of the normal matrix's trace
_UPPER = np.triu_indices(alignment.UNKNOWNS)


@dataclass(frozen=True)
class NormalEquations:
    """J^T W J, J^T W r and the statistics of one evaluation."""

    A: NDArray[np.float64]  # [6, 6]
    b: NDArray[np.float64]  # [6]
    live_pixels: int
    candidates: float  # live pixels that meet a model pixel
    matched: float  # of them, with depths that agree roughly
    inliers: float  # of them, within three sigma
    depth_residual: float  # mean, in sigmas
    colour_residual: float  # mean, in intensity
    intensity: IntensityMoments


class GaussNewtonTracker:
    """Minimises the RGB-depth objective over the pose and the frame's gain and bias."""

    def __init__(self, camera: Camera, config: TrackingConfig, loss: LossConfig) -> None:
        self.config, self.loss = config, loss
        self.stopwatch: Stopwatch | None = None
        self.first = finest_level(camera, config.finest_width_px)
        self.camera = camera
        self.detector = LostDetector(config)
        self.rasterizer = Rasterizer(camera)

    def track(
        self, frame: Frame, gaussians: GaussianMap, T_cw: NDArray[np.float64], exposure: Exposure
    ) -> TrackingResult:
        """Pose of `frame` from the prediction T_cw [4, 4] and the last frame's exposure."""
        with stage(self.stopwatch, "pyramid"):
            live = live_pyramid(frame, self.camera, self.first, len(self.config.iterations), self.loss)
        for _ in range(self.config.renders):
            model = self._model(gaussians, T_cw)
            with stage(self.stopwatch, "align"):
                T_ml, exposure, last = self._align(live, model, exposure)
            T_cw = inverse(T_ml) @ T_cw
        return self._result(T_cw, T_ml, exposure, last)

    def assess(
        self, frame: Frame, gaussians: GaussianMap, T_cw: NDArray[np.float64], exposure: Exposure
    ) -> TrackingResult:
        """What the frame says of a pose that another solver found; the pose stays as it is."""
        live = live_pyramid(frame, self.camera, self.first, 1, self.loss)
        equations = self._linearise(live[0], self._model(gaussians, T_cw)[0], np.eye(4), exposure)
        return self._result(T_cw, np.eye(4), exposure, equations)

    def _result(
        self, T_cw: NDArray[np.float64], T_ml: NDArray[np.float64], exposure: Exposure, last: NormalEquations
    ) -> TrackingResult:
        information = adjoint(T_ml).T @ last.A @ adjoint(T_ml)
        measures = {
            "inlier_ratio": last.inliers / max(last.matched, 1.0),
            "overlap": last.candidates / max(last.live_pixels, 1.0),
            "agreement": last.matched / max(last.candidates, 1.0),
            "depth_residual_sigmas": last.depth_residual,
            "colour_residual": last.colour_residual,
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
            return self._model_pyramid(rendered)

    def _model_pyramid(self, rendered: RenderImages) -> list[ModelLevel]:
        opacity = runtime.to_host(rendered.opacity)
        covered = opacity > self.config.min_opacity
        safe = np.maximum(opacity, self.config.min_opacity)
        depth = runtime.to_device(np.where(covered, runtime.to_host(rendered.depth) / safe, np.float32(0.0)))
        grey = images.luminance(rendered.colour)  # not divided: the map's colours are fitted to be seen over black
        for _ in range(self.first):
            depth, grey = images.halve_depth(depth), images.halve(grey)
        camera = self.camera.halved(self.first)
        return model_pyramid(grey, depth, camera, len(self.config.iterations), self.loss.depth_sigma_per_m2)

    def _align(
        self, live: list[LiveLevel], model: list[ModelLevel], exposure: Exposure
    ) -> tuple[NDArray[np.float64], Exposure, NormalEquations]:
        """Coarse to fine from the identity; returns T_ml, the exposure, and the last equations."""
        T_ml = np.eye(4)
        for level in reversed(range(len(live))):
            for _ in range(self.config.iterations[level]):
                equations = self._linearise(live[level], model[level], T_ml, exposure)
                exposure = fit_exposure(equations.intensity, self.config.exposure, exposure)
                # a weak damping holds the directions that nothing observes
                damping = _DAMPING * np.trace(equations.A) + 1e-9
                step = np.linalg.solve(equations.A + damping * np.eye(6), -equations.b)
                T_ml = se3_exp(step) @ T_ml
                if np.abs(step).max() < _CONVERGED:
                    break
        return T_ml, exposure, equations

    def _linearise(
        self, live: LiveLevel, model: ModelLevel, T_ml: NDArray[np.float64], exposure: Exposure
    ) -> NormalEquations:
        config, camera = self.config, live.camera
        settings = np.zeros(alignment.SETTINGS, np.float32)
        settings[[alignment.FX, alignment.FY, alignment.CX, alignment.CY]] = camera.fx, camera.fy, camera.cx, camera.cy
        settings[alignment.GAIN], settings[alignment.BIAS] = exposure.gain, exposure.bias
        settings[alignment.DEPTH_SIGMA] = self.loss.depth_sigma_per_m2
        settings[alignment.MAX_DISTANCE_SIGMAS] = config.max_distance_sigmas
        settings[alignment.CHARBONNIER_DEPTH] = self.loss.charbonnier_depth_sigmas
        settings[alignment.GATE_DEPTH_BOOST] = self.loss.gate_depth_boost
        settings[[alignment.SIGMA_COLOUR, alignment.SIGMA_GRADIENT]] = config.sigma_colour, config.sigma_gradient
        settings[alignment.WEIGHT_DEPTH] = config.weight_depth
        settings[alignment.WEIGHT_COLOUR] = config.weight_colour
        settings[alignment.WEIGHT_GRADIENT] = config.weight_gradient
        partial = runtime.empty((camera.height * alignment.SPLIT, alignment.PARTIAL))
        alignment.normal_equations(
            runtime.to_device(settings), runtime.to_device(T_ml[:3].reshape(12)),
            live.depth, live.grey, live.grad_x, live.grad_y, live.gate,
            model.depth, model.normal, model.grey, model.grad_x, model.grad_y,
            model.grad_xx, model.grad_xy, model.grad_yy, partial,
        )  # fmt: skip
        sums = runtime.to_host(partial).sum(0, dtype=np.float64)
        A = np.zeros((alignment.UNKNOWNS, alignment.UNKNOWNS))
        A[_UPPER] = sums[: alignment.TRIANGLE]
        matched = max(sums[alignment.MATCHED], 1.0)
        return NormalEquations(
            A=A + np.triu(A, 1).T,
            b=sums[alignment.RHS : alignment.RHS + alignment.UNKNOWNS],
            live_pixels=int(np.count_nonzero(runtime.to_host(live.depth))),
            candidates=float(sums[alignment.CANDIDATES]),
            matched=float(sums[alignment.MATCHED]),
            inliers=float(sums[alignment.INLIERS]),
            depth_residual=float(sums[alignment.DEPTH_SUM] / matched),
            colour_residual=float(sums[alignment.COLOUR_SUM] / matched * config.sigma_colour),
            intensity=IntensityMoments(*(float(m) for m in sums[alignment.W : alignment.W_LM + 1])),
        )
