"""The two solvers behind one interface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.map_settings import LossConfig
from tgslam.config.tracking_settings import TrackingConfig
from tgslam.device.stopwatch import Stopwatch
from tgslam.map.gaussians import GaussianMap
from tgslam.ops.rasterize import Rasterizer
from tgslam.tracking.first_order import FirstOrderTracker
from tgslam.tracking.gauss_newton import GaussNewtonTracker
from tgslam.tracking.pyramid import finest_level
from tgslam.tracking.references import Reference
from tgslam.tracking.result import TrackingResult
from tgslam.types import Exposure, Frame


class Tracker(Protocol):
    """A solver for the pose of one frame."""

    rasterizer: Rasterizer  # holds which Gaussians the last model image saw
    stopwatch: Stopwatch | None  # set it to have the stages timed, for benchmarks

    def know(self, planes_w: NDArray[np.float64], references: Sequence[Reference]) -> None:
        """What the next frames are likely to see.

        planes_w: [P, 4] in the world: n . x + d = 0, n towards where the camera is. references: keyframes, the most
        important first; no more of them than `TrackingConfig.references` are used.
        """
        ...

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
        """Pose of `frame` from the prediction T_cw [4, 4] (world to camera) and the last frame's exposure.

        prior: [6, 6] information on a left perturbation of T_cw, how far it is to be trusted; None = a place to start.
        firm: it was measured, and counts beside the pixels; else it only speaks where they do not.
        """
        ...

    def assess(
        self,
        frame: Frame,
        gaussians: GaussianMap,
        T_cw: NDArray[np.float64],
        exposure: Exposure,
        *,
        fits_exposure: bool = False,
    ) -> TrackingResult:
        """What the frame says of a pose that was found otherwise; the pose stays as it is, and so does the exposure
        unless it is to be fitted.
        """
        ...

    def accept(self, result: TrackingResult) -> None:
        """It is what a frame has been tracked to: what it measured becomes usual."""
        ...


def make_tracker(camera: Camera, config: TrackingConfig, loss: LossConfig) -> Tracker:
    """The solver that the config names."""
    if config.solver == "first_order":
        return FirstOrderTracker(camera, config, loss)
    return GaussNewtonTracker(camera, config, loss)


def coarsest(camera: Camera, config: TrackingConfig) -> Camera:
    """Of the images that alignment begins with."""
    steps = config.alignment_steps if config.solver != "first_order" else config.expert.first_order.adam_steps
    return camera.halved(finest_level(camera, config.finest_width_px) + len(steps) - 1)
