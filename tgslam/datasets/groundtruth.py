"""Reading published ground truth: TUM's text and its kin, with the gaps and faulty rows that it has in practice."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.errors import DatasetError
from tgslam.files.pose_text import PoseTable, read_pose_table
from tgslam.types import Trajectory

_log = logging.getLogger(__name__)


def groundtruth_file(folder: Path) -> Path:
    """groundtruth.txt, or .csv, of a folder; of one without either, the former."""
    names = ("groundtruth.txt", "groundtruth.csv")
    return next((folder / name for name in names if (folder / name).exists()), folder / names[0])


def poses_of_file(path: Path, times_s: Sequence[float]) -> Callable[[], Trajectory | None]:
    """Reads the ground truth when it is called; None without such a file. times_s: of the frames."""
    return partial(_read_if_there, path, times_s)


def _read_if_there(path: Path, times_s: Sequence[float]) -> Trajectory | None:
    return read_groundtruth(path, times_s) if path.exists() else None


def read_groundtruth(path: Path, times_s: Sequence[float] | None = None) -> Trajectory:
    """A file of poses, of any kind that `read_pose_table` knows -> camera-to-world poses at increasing times.

    times_s: when the frames were taken, for files that have a pose a frame and no times, as KITTI's.
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
    found_s = (_frame_times(path, table, times_s) if table.times_s is None else table.times_s)[usable]
    _, unique = np.unique(found_s, return_index=True)  # sorts as well
    if len(unique) < len(found_s):
        _log.warning("%s: dropped %d rows whose timestamp had come before", path, len(found_s) - len(unique))
    return Trajectory(found_s[unique], table.T_wc[usable][unique])


def _frame_times(path: Path, table: PoseTable, times_s: Sequence[float] | None) -> NDArray[np.float64]:
    """[N] of a table without times, by the frames that its rows belong to."""
    if times_s is None or len(times_s) != len(table.lines):
        frames = "the frames are not known here" if times_s is None else f"there are {len(times_s)} frames"
        raise DatasetError(
            f"{path}: {len(table.lines)} rows of matrices, as KITTI has them, without times, but {frames}; put a time "
            "first in each row"
        )
    return np.asarray(times_s, np.float64)
