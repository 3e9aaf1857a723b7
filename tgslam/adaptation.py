"""The system for any sensor and any scale: what the first frame tells of both is settled before anything is built."""

from __future__ import annotations

import dataclasses

import numpy as np

from tgslam.boundary import FrameCheck
from tgslam.camera import USUAL_NOISE, Camera
from tgslam.config.schema import Config
from tgslam.sensing import learn_noise, median_depth_m, unit_of
from tgslam.slam import Slam as RoomSlam
from tgslam.types import Frame, FrameReport, Gaussians, Plane, Trajectory

_UNUSUAL = 2.0  # times the usual noise; up to here, it is one sensor's as well as another's


class Slam:
    """RGB-D frames in; poses, a Gaussian map and persistent planes out. The first frame's camera is the world frame.

    Within, lengths are in a unit that makes the world about as large as a room: thresholds in metres are for rooms. All
    that comes out is in metres again. The unit is a power of two, so that nothing is rounded on the way.
    """

    def __init__(self, camera: Camera, config: Config) -> None:
        """Raises ConfigError for settings that do not go together."""
        self.camera, self.config = camera, config
        self._check, self._started = FrameCheck(camera), False
        self._unit_m, self._slam = 1.0, RoomSlam(camera, config)

    def process_frame(self, frame: Frame) -> FrameReport:
        """Estimate the frame's pose and, if it shows something new, map it. Frames come in order of time.

        Raises FrameError, with nothing changed, for a frame with next to no depth or of another size than the camera's.
        """
        if not self._started:
            self._adapt(self._check(frame))
        report = self._slam.process_frame(self._in_units(frame))
        self._started = True
        return self._report_in_metres(report)

    def finish(self) -> None:
        """The final refinement of the map, after the last frame."""
        self._slam.finish()

    def trajectory(self) -> Trajectory:
        """Camera-to-world poses of every frame that was given."""
        return self._in_metres(self._slam.trajectory())

    def keyframe_trajectory(self) -> Trajectory:
        """Camera-to-world poses of the keyframes."""
        return self._in_metres(self._slam.keyframe_trajectory())

    def keyframe_indices(self) -> list[int]:
        """`Frame.index` of the keyframes."""
        return self._slam.keyframe_indices()

    def gaussians(self) -> Gaussians:
        """The map, on the host."""
        return _scaled_gaussians(self._slam.gaussians(), self._unit_m)

    def planes(self) -> tuple[Plane, ...]:
        """The persistent planes by id, empty when planes are not looked for."""
        return tuple(_scaled_plane(plane, self._unit_m) for plane in self._slam.planes())

    def _adapt(self, first: Frame) -> None:
        """Build the system anew if the first frame, checked, is of another scale or sensor than the usual ones."""
        config = self.config
        self._unit_m = unit_of(first.depth_m) if config.unit_m is None else config.unit_m
        per_m2 = config.loss.depth_sigma_per_m2
        per_unit = _noise_per_unit(first, self._unit_m) if per_m2 is None else per_m2 * self._unit_m
        loss = dataclasses.replace(config.loss, depth_sigma_per_m2=per_unit)
        if loss.noise != self._slam.config.loss.noise:
            self._slam = RoomSlam(self.camera, dataclasses.replace(config, loss=loss))

    def _in_units(self, frame: Frame) -> Frame:
        """The frame with depth in units, checked while it still is in metres."""
        if self._unit_m == 1.0:
            return frame
        checked = self._check(frame)
        return dataclasses.replace(checked, depth_m=checked.depth_m * np.float32(1.0 / self._unit_m))

    def _in_metres(self, trajectory: Trajectory) -> Trajectory:
        T_wc = trajectory.T_wc.copy()
        T_wc[:, :3, 3] *= self._unit_m
        return Trajectory(trajectory.timestamps_s, T_wc)

    def _report_in_metres(self, report: FrameReport) -> FrameReport:
        if report.T_wc is None or self._unit_m == 1.0:
            return report
        T_wc = report.T_wc.copy()
        T_wc[:3, 3] *= self._unit_m
        return dataclasses.replace(report, T_wc=T_wc)


def _noise_per_unit(first: Frame, unit_m: float) -> float:
    """The sensor's noise at the depths that the first frame shows; the usual one where it is no more, or not told."""
    learnt = learn_noise(first.depth_m)
    found = 0.0 if learnt is None else learnt.equivalent_per_m2(median_depth_m(first.depth_m)) * unit_m
    return found if found > _UNUSUAL * USUAL_NOISE.per_m2 else USUAL_NOISE.per_m2


def _scaled_gaussians(gaussians: Gaussians, factor: float) -> Gaussians:
    if factor == 1.0:
        return gaussians
    mean = gaussians.mean * np.float32(factor)
    return dataclasses.replace(gaussians, mean=mean, log_scale=gaussians.log_scale + np.float32(np.log(factor)))


def _scaled_plane(plane: Plane, factor: float) -> Plane:
    axes = np.array([1.0, 1.0, factor])
    return dataclasses.replace(
        plane,
        offset_m=plane.offset_m * factor,
        centroid_w=plane.centroid_w * factor,
        covariance=plane.covariance * np.outer(axes, axes),
        polygons_w=tuple(polygon * factor for polygon in plane.polygons_w),
        area_m2=plane.area_m2 * factor**2,
        inlier_rms_m=plane.inlier_rms_m * factor,
    )
