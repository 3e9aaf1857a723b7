"""What a run has found, as the files of its folder."""

from __future__ import annotations

from typing import Protocol

from tgslam.output.ply import write_map
from tgslam.output.run_folder import RunFolder
from tgslam.output.trajectory_io import write_trajectory
from tgslam.types import Gaussians, Plane, Trajectory


class Found(Protocol):
    """What a SLAM system gives of itself."""

    def trajectory(self) -> Trajectory:
        """Camera-to-world poses of every frame that was not skipped."""

    def keyframe_trajectory(self) -> Trajectory:
        """Camera-to-world poses of the keyframes."""

    def gaussians(self) -> Gaussians:
        """The map."""

    def planes(self) -> tuple[Plane, ...]:
        """The persistent planes by id, empty when the system looks for none."""


def write_results(folder: RunFolder, found: Found) -> None:
    """Write trajectories, planes and, last, map.ply: with it a run is complete.

    Raises OutputError for values that are not finite, and OSError.
    """
    write_trajectory(folder.trajectory, found.trajectory())
    write_trajectory(folder.keyframes, found.keyframe_trajectory())
    gaussians = found.gaussians()
    folder.write_planes(found.planes(), gaussians)
    write_map(folder.map, gaussians)
