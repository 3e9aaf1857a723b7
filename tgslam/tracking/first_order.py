"""First-order tracking, as the paper's: render, compare, follow the rasterizer's pose gradient, coarse to fine."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.map_settings import LossConfig
from tgslam.config.tracking_settings import TrackingConfig
from tgslam.device import runtime
from tgslam.device.stopwatch import Stopwatch, stage
from tgslam.geometry import se3_exp
from tgslam.map.gaussians import GaussianMap
from tgslam.ops import image as images
from tgslam.ops import loss as losses
from tgslam.ops.rasterize import ImageGradient, Rasterizer
from tgslam.ops.splats import MapGradient
from tgslam.ops.vector_adam import VectorAdam
from tgslam.tracking.gauss_newton import GaussNewtonTracker
from tgslam.tracking.pyramid import finest_level
from tgslam.tracking.references import Reference
from tgslam.tracking.result import TrackingResult
from tgslam.types import Exposure, Frame


class FirstOrderTracker:
    """Adam on the pose and the exposure under the whole of Eqs. 10-13, SSIM included."""

    def __init__(self, camera: Camera, config: TrackingConfig, loss: LossConfig) -> None:
        self.config, self.loss = config, loss
        self.stopwatch: Stopwatch | None = None
        self.first = finest_level(camera, config.finest_width_px)
        self.cameras = [camera.halved(self.first + level) for level in range(len(config.expert.first_order.adam_steps))]
        self.rasterizers = [Rasterizer(level) for level in self.cameras]
        self.workspaces = [losses.Workspace(level.height, level.width) for level in self.cameras]
        self._gradient = MapGradient.zeros(1)
        self._judge = GaussNewtonTracker(camera, config, loss)
        self.rasterizer = self._judge.rasterizer

    def know(self, planes_w: NDArray[np.float64], references: Sequence[Reference]) -> None:
        """See `Tracker.know`: this solver, as the paper's, compares the frame with what is rendered, and no more."""

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
        """See `Tracker.track`. The prior plays no part: steps are small enough to stay near the prediction."""
        if self._gradient.mean.shape[0] != gaussians.capacity:
            self._gradient = MapGradient.zeros(gaussians.capacity)
        if self.config.exposure == "none":
            exposure = Exposure()
        with stage(self.stopwatch, "pyramid"):
            observations = self._observations(frame)
        with stage(self.stopwatch, "align"):
            for level in reversed(range(len(self.cameras))):
                T_cw, exposure = self._descend(level, observations[level], gaussians, T_cw, exposure)
        with stage(self.stopwatch, "judge"):
            return self._judge.assess(frame, gaussians, T_cw, exposure)

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
        return self._judge.assess(frame, gaussians, T_cw, exposure, fits_exposure=fits_exposure)

    def accept(self, result: TrackingResult) -> None:
        """See `Tracker.accept`."""
        self._judge.accept(result)

    def _observations(self, frame: Frame) -> list[losses.Observation]:
        colour, depth_m = runtime.to_device(frame.colour), runtime.to_device(frame.depth_m)
        for _ in range(self.first):
            colour, depth_m = images.halve(colour), images.halve_depth(depth_m)
        result = []
        for level in range(len(self.cameras)):
            if level:
                colour, depth_m = images.halve(colour), images.halve_depth(depth_m)
            result.append(losses.observe(colour, depth_m, self.loss))
        return result

    def _descend(
        self,
        level: int,
        observation: losses.Observation,
        gaussians: GaussianMap,
        T_cw: NDArray[np.float64],
        exposure: Exposure,
    ) -> tuple[NDArray[np.float64], Exposure]:
        rasterizer = self.rasterizers[level]
        rate = self.config.expert.first_order.adam_rate
        fits_gain, fits_bias = self.config.exposure != "none", self.config.exposure == "gain_bias"
        adam = VectorAdam([rate] * 6 + [rate * fits_gain, rate * fits_bias])
        to_frame = np.array([1.0 / exposure.gain, -exposure.bias / exposure.gain])  # the loss fits map to frame
        for _ in range(self.config.expert.first_order.adam_steps[level]):
            rendered = rasterizer.forward(gaussians, T_cw)
            result = losses.rgbd_loss(
                rendered.colour, rendered.depth, rendered.opacity, observation, self.loss, to_frame[0], to_frame[1],
                min_opacity=self.config.expert.model.min_opacity, workspace=self.workspaces[level],
            )  # fmt: skip
            g = ImageGradient(result.g_colour, result.g_depth, result.g_opacity)
            g_pose = rasterizer.backward(gaussians, g, self._gradient)
            step = adam.step(np.concatenate([g_pose, [result.g_gain, result.g_bias]]))
            T_cw = se3_exp(step[:6]) @ T_cw
            to_frame = to_frame + step[6:]
        return T_cw, Exposure(float(1.0 / to_frame[0]), float(-to_frame[1] / to_frame[0]))
