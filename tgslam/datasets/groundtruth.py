"""Reading published ground truth, which has gaps and faulty rows in practice."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.errors import DatasetError
from tgslam.files.pose_text import PoseTable, read_pose_table
from tgslam.types import Trajectory

_log = logging.getLogger(__name__)


def read_groundtruth(path: Path, frames_s: Sequence[float] | None = None) -> Trajectory:
    """A file of poses -> camera-to-world poses at increasing times.

    frames_s: when the frames were taken, for files that have a pose a frame and no times, as KITTI's.
    Rows with NaN, infinite values or no rotation and repeated times are dropped with a warning; rows out of order are
    sorted. Raises DatasetError for a malformed row (file and line), or when no row is usable.
    """
    table = read_pose_table(path, DatasetError)
    usable = table.usable
    if not usable.any():
        raise DatasetError(
            f"{path}: none of its {len(table.lines)} rows is a usable pose (finite numbers, quaternion not zero); "
            "delete the file to run without ground truth"
        )
    if not usable.all():
        first = table.lines[int(np.argmin(usable))]
        _log.warning("%s: dropped %d rows without a usable pose, the first on line %d", path, (~usable).sum(), first)
    times_s = (_frame_times(path, table, frames_s) if table.times_s is None else table.times_s)[usable]
    _, unique = np.unique(times_s, return_index=True)  # sorts as well
    if len(unique) < len(times_s):
        _log.warning("%s: dropped %d rows whose timestamp had come before", path, len(times_s) - len(unique))
    return Trajectory(times_s[unique], table.T_wc[usable][unique])


def _frame_times(path: Path, table: PoseTable, frames_s: Sequence[float] | None) -> NDArray[np.float64]:
    """[N] of a table without times, by the frames that its rows belong to."""
    if frames_s is None:
        raise DatasetError(f"{path}: its poses have no times, so what they belong to is not known; put a time before")
    if len(frames_s) != len(table.lines):
        raise DatasetError(
            f"{path}: holds {len(table.lines)} poses without times, but there are {len(frames_s)} frames; "
            "without times, there must be one a frame"
        )
    return np.asarray(frames_s, np.float64)
