"""Trajectories as TUM text: `timestamp tx ty tz qx qy qz qw`, camera-to-world, metres, one pose a line."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tgslam.errors import OutputError
from tgslam.files.atomic import write_text
from tgslam.files.tum_text import read_pose_rows, trajectory_from_rows, usable_pose_rows
from tgslam.geometry import quat_wxyz_from_matrix
from tgslam.types import Trajectory


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory in a fixed format (the same poses give the same bytes), or leave the file as it was.

    Times have 6 decimals, positions and quaternions 9; qw >= 0. An empty trajectory gives an empty file. Raises
    OutputError for poses that are not finite, times that do not increase, and a file that cannot be written.
    """
    problem = _problem(trajectory)
    if problem:
        raise OutputError(f"{path}: not written, {problem}")
    lines = []
    for timestamp_s, T_wc in zip(trajectory.timestamps_s, trajectory.T_wc, strict=True):
        w, x, y, z = quat_wxyz_from_matrix(T_wc[:3, :3])
        pose = " ".join(f"{value:.9f}" for value in (*T_wc[:3, 3], x, y, z, w))
        lines.append(f"{timestamp_s:.6f} {pose}\n")
    try:
        write_text(path, "".join(lines))
    except OSError as cause:
        raise OutputError(
            f"{path}: cannot be written ({cause.strerror}); check the folder and the free space"
        ) from cause


def read_trajectory(path: Path) -> Trajectory:
    """Read a trajectory file that a run wrote: strict, unlike the reader of published ground truth.

    Comments and empty lines are allowed, and so is an empty file. Raises OutputError, with file and line, for a
    malformed row, a value that is not finite, a zero quaternion, and a time that is not after the one before.
    """
    lines, values = read_pose_rows(path, OutputError)
    usable = usable_pose_rows(values)
    if not usable.all():
        line = lines[int(np.argmin(usable))]
        raise OutputError(f"{path}:{line}: not a pose; all values must be finite and the quaternion not zero")
    increasing = np.diff(values[:, 0]) > 0
    if not increasing.all():
        line = lines[int(np.argmin(increasing)) + 1]
        raise OutputError(f"{path}:{line}: its timestamp is not after that of the pose before")
    return trajectory_from_rows(values)


def _problem(trajectory: Trajectory) -> str:
    times, poses = trajectory.timestamps_s, trajectory.T_wc
    finite = np.isfinite(times) & np.isfinite(poses).all(axis=(1, 2))
    if not finite.all():
        return f"pose {int(np.argmin(finite))} is not finite"
    if (np.diff(np.round(times, 6)) <= 0).any():
        return "its timestamps do not increase by a microsecond or more"
    return ""
