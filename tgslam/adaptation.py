"""The system for any sensor and any scale: what the first frame tells of both is settled before anything is built."""

from __future__ import annotations

import dataclasses
import logging

import numpy as np

from tgslam.boundary import FrameCheck
from tgslam.camera import USUAL_NOISE, Camera
from tgslam.config.schema import Config
from tgslam.errors import FrameError
from tgslam.geometry import is_motion
from tgslam.sensing import UNUSUAL, learn_noise, likelier_scale, median_depth_m, reach_m, unit_of
from tgslam.slam import Slam as RoomSlam
from tgslam.types import Frame, FrameReport, Gaussians, Matrix4, Plane, Trajectory

_log = logging.getLogger(__name__)
_USUAL_SCALE = 5000.0  # units of depth in a metre where the settings leave them open: the TUM benchmark's


class Slam:
    """RGB-D frames in; poses, a Gaussian map and persistent planes out. The first frame's camera is the world frame.

    Within, lengths are in a unit that makes the world about as large as a room: thresholds in metres are for rooms. All
    that comes out is in metres again. The unit is a power of two, so that nothing is rounded on the way.
    """

    def __init__(self, camera: Camera, config: Config) -> None:
        self.camera, self.config = camera, config
        self._check, self._started = FrameCheck(camera), False
        self._unit_m, self._slam = 1.0, RoomSlam(camera, _held(config))

    def process_frame(self, frame: Frame, T_wc: Matrix4 | None = None) -> FrameReport:
        """Estimate the frame's pose and, if it shows something new, map it. Frames come in order of time.

        T_wc: the pose [4, 4], camera to world, where it is known beforehand; `poses.use` says what for. The world is
        then theirs. Raises FrameError, with nothing changed, for a frame with next to no depth or of another size than
        the camera's, and for one whose pose is needed and not known.
        """
        known = self._known(frame, T_wc)
        if self._started:
            return self._report_in_metres(self._slam.process_frame(self._in_units(frame), self._pose_in_units(known)))
        self._adapt(self._check(frame))
        first = self._slam.process_frame(self._in_units(frame), self._pose_in_units(known))
        report = self._report_in_metres(first)
        self._started = True
        per_m2 = self._slam.config.loss.noise.per_m2 / self._unit_m
        settled = {"depth_sigma_per_m2": per_m2, "unit_m": self._unit_m}
        return dataclasses.replace(report, measures=report.measures | settled)

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
        config, reach = self.config, reach_m(first.depth_m)
        found = _noise_per_m2(first)
        self._unit_m = unit_of(reach) if config.unit_m is None else config.unit_m
        if config.loss.depth_sigma_per_m2 is not None:
            per_unit = config.loss.depth_sigma_per_m2 * self._unit_m
        else:
            per_unit = found * self._unit_m
            if per_unit <= UNUSUAL * USUAL_NOISE.per_m2:  # sensors are much alike, and less noise is no gain
                per_unit = USUAL_NOISE.per_m2
        if config.unit_m is None:
            _warn_of_scale(config.dataset.depth_scale or _USUAL_SCALE, found, reach, self._unit_m)
        loss = dataclasses.replace(config.loss, depth_sigma_per_m2=per_unit)
        poses = dataclasses.replace(config.poses, sigma_m=config.poses.sigma_m / self._unit_m)
        if loss.noise != self._slam.config.loss.noise or (poses.use == "prior" and self._unit_m != 1.0):
            self._slam = RoomSlam(self.camera, dataclasses.replace(_held(config), loss=loss, poses=poses))

    def _known(self, frame: Frame, T_wc: Matrix4 | None) -> Matrix4 | None:
        """The pose, checked. In `fixed`, every frame needs one; else the first one does, as the world is theirs."""
        use = self.config.poses.use
        if T_wc is None:
            if use == "fixed" or (use == "prior" and not self._started):
                raise FrameError(f"frame {frame.index}: its pose is not known, which poses.use={use} needs")
            return None
        if use == "none":
            raise FrameError(f"frame {frame.index}: a pose is given, but poses.use is none; set it to fixed or prior")
        if np.shape(T_wc) != (4, 4) or not is_motion(T_wc):
            raise FrameError(f"frame {frame.index}: its known pose is no rigid motion [4, 4]")
        return np.asarray(T_wc, np.float64)

    def _pose_in_units(self, T_wc: Matrix4 | None) -> Matrix4 | None:
        if T_wc is None or self._unit_m == 1.0:
            return T_wc
        T_wc = T_wc.copy()
        T_wc[:3, 3] /= self._unit_m
        return T_wc

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


def _held(config: Config) -> Config:
    """The settings without what would move keyframes whose poses are known."""
    if config.poses.use != "fixed":
        return config
    return dataclasses.replace(
        config,
        mapping=dataclasses.replace(config.mapping, refine_poses=False),
        closures=dataclasses.replace(config.closures, enabled=False),
        loops=dataclasses.replace(config.loops, enabled=False),
    )


def _noise_per_m2(first: Frame) -> float:
    """The sensor's noise at the depths that the first frame shows, 1/m; the usual one where it does not tell."""
    learnt = learn_noise(first.depth_m)
    return USUAL_NOISE.per_m2 if learnt is None else learnt.equivalent_per_m2(median_depth_m(first.depth_m))


def _warn_of_scale(depth_scale: float, per_m2: float, reach: float, unit_m: float) -> None:
    """Say so where depth may have been read by a wrong scale."""
    other = likelier_scale(depth_scale, per_m2, reach)
    if other is not None:
        _log.warning(
            "depth may be read wrongly: by dataset.depth_scale=%g all is within %.2g m, noise %.2g times the usual; "
            "dataset.depth_scale=%g makes a room of it, seen by a usual sensor, with lengths %g times as large",
            depth_scale, reach, per_m2 / USUAL_NOISE.per_m2, other, depth_scale / other,
        )  # fmt: skip
    elif unit_m != 1.0:
        _log.warning(
            "the first frame shows nothing beyond %.2g m, which is no room: settings in metres count in %g m; if it is "
            "one, check dataset.depth_scale; unit_m says how large the world is",
            reach, unit_m,
        )  # fmt: skip


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
