"""Reading published ground truth, which has gaps and faulty rows in practice."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from tgslam.errors import DatasetError
from tgslam.files.tum_text import read_pose_rows, trajectory_from_rows, usable_pose_rows
from tgslam.types import Trajectory

_log = logging.getLogger(__name__)


def read_groundtruth(path: Path) -> Trajectory:
    """TUM text -> camera-to-world poses at increasing times.

    Rows with NaN, infinite values or a zero quaternion and repeated times are dropped with a warning; rows out of
    order are sorted. Raises DatasetError for a malformed row (file and line), or when no row is usable.
    """
    lines, values = read_pose_rows(path, DatasetError)
    usable = usable_pose_rows(values)
    if not usable.any():
        raise DatasetError(
            f"{path}: none of its {len(values)} rows is a usable pose (finite numbers, quaternion not zero); "
            "delete the file to run without ground truth"
        )
    if not usable.all():
        first = lines[int(np.argmin(usable))]
        _log.warning("%s: dropped %d rows without a usable pose, the first on line %d", path, (~usable).sum(), first)
    values = values[usable]
    _, unique = np.unique(values[:, 0], return_index=True)  # sorts as well
    if len(unique) < len(values):
        _log.warning("%s: dropped %d rows whose timestamp had come before", path, len(values) - len(unique))
    return trajectory_from_rows(values[unique])
