"""What a run folder holds, as exports take it: in one world frame, and read only where a format needs it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from tgslam.camera import Camera
from tgslam.datasets.source import RgbdSource
from tgslam.errors import FrameError, OutputError
from tgslam.exports.levelling import level_transform
from tgslam.exports.moved import moved_gaussians, moved_planes, moved_trajectory
from tgslam.output.log import read_log
from tgslam.output.planes_io import read_planes
from tgslam.output.ply import read_map
from tgslam.output.run_folder import RunFolder
from tgslam.output.trajectory_io import read_trajectory
from tgslam.types import Frame, FrameStatus, Gaussians, Matrix4, Plane, Trajectory

_log = logging.getLogger(__name__)
_KNOWN = (FrameStatus.INITIAL, FrameStatus.TRACKED)  # frames whose pose is no guess
_DECIMALS = 6  # of times in a trajectory file


@dataclass(frozen=True)
class View:
    """An image of the run's input and where it was taken."""

    number: int  # from 0, without those that were left out
    frame: Frame
    T_wc: Matrix4  # [4, 4]


class RunContent:
    """The files of a run, moved into the world of the export."""

    def __init__(
        self,
        folder: RunFolder,
        open_source: Callable[[], RgbdSource],
        *,
        level: bool = False,
        every_frame: bool = False,
    ) -> None:
        """open_source: the input of the run. level: see `level_transform`. every_frame: views are not of keyframes
        alone.
        """
        self.folder = folder
        self.level, self.every_frame = level, every_frame
        self._open_source = open_source

    @cached_property
    def camera(self) -> Camera:
        """Of the images, which have no distortion."""
        return self.folder.read_record().camera

    @cached_property
    def T_lw(self) -> Matrix4:
        """[4, 4] from the run's world into that of the export."""
        if not self.level:
            return np.eye(4)
        poses = self._stored_trajectory
        return level_transform(self.plan_planes, self._stored_gaussians, poses.T_wc[0] if len(poses) else np.eye(4))

    @cached_property
    def gaussians(self) -> Gaussians:
        """The map. Raises OutputError where the run has none."""
        return moved_gaussians(self._stored_gaussians, self.T_lw) if self.level else self._stored_gaussians

    @cached_property
    def trajectory(self) -> Trajectory:
        """Poses of every frame. Raises OutputError where the run has none."""
        return moved_trajectory(self._stored_trajectory, self.T_lw)

    @cached_property
    def planes(self) -> tuple[Plane, ...]:
        """The planes, in the world of the export."""
        return moved_planes(self.plan_planes, self.T_lw) if self.level else self.plan_planes

    @cached_property
    def plan_planes(self) -> tuple[Plane, ...]:
        """The planes in the run's own world, which floor plans are drawn from: they are level anyway."""
        return read_planes(self.folder.planes) if self.folder.planes.exists() else ()

    def views(self) -> Iterator[View]:
        """The keyframes, or all frames with a known pose, as the run saw them. Frames that cannot be read are left out.

        Raises OutputError when none is left, and what opening the input raises.
        """
        rows = {round(float(t), _DECIMALS): row for row, t in enumerate(self.trajectory.timestamps_s)}
        source = self._open_source()
        number = 0
        for position, report in enumerate(read_log(self.folder.log)):
            row = rows.get(round(report.timestamp_s, _DECIMALS))
            wanted = report.status in _KNOWN if self.every_frame else report.is_keyframe
            if row is None or not wanted:
                continue
            try:
                frame = source.read(position)
            except FrameError as error:
                _log.warning("frame %d is left out: %s", position, error)
                continue
            yield View(number, frame, self.trajectory.T_wc[row])
            number += 1
        if not number:
            raise OutputError(f"{self.folder.path}: this run has no image with a known pose to export")

    @cached_property
    def _stored_gaussians(self) -> Gaussians:
        return read_map(self._there(self.folder.map, self.folder.partial_map))

    @cached_property
    def _stored_trajectory(self) -> Trajectory:
        return read_trajectory(self._there(self.folder.trajectory, self.folder.partial_trajectory))

    def _there(self, whole: Path, partial: Path) -> Path:
        """The file of a whole run, else that of a run that was cut off."""
        if whole.exists():
            return whole
        if not partial.exists():
            raise OutputError(f"{self.folder.path}: this run has neither {whole.name} nor {partial.name} to export")
        _log.warning("%s: this run was cut off; %s is exported", self.folder.path, partial.name)
        return partial
