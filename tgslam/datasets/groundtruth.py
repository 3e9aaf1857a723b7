"""Reading published ground truth: TUM's text and its kin, with the gaps and faulty rows that it has in practice."""

from __future__ import annotations

import logging
import re
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.datasets.pose_rows import rows_of_matrices
from tgslam.datasets.time_matching import seconds_in
from tgslam.errors import DatasetError
from tgslam.files.tum_text import Row, read_rows, trajectory_from_rows, usable_pose_rows
from tgslam.types import Trajectory

_log = logging.getLogger(__name__)
_EXPECTED = "8 numbers (timestamp tx ty tz qx qy qz qw)"
_KITTI, _TIMED_KITTI, _SQUARE, _EUROC = 12, 13, 16, 17  # numbers in a row
_SCALAR_FIRST, _SCALAR_LAST = [0, 1, 2, 3, 5, 6, 7, 4], [0, 1, 2, 3, 4, 5, 6, 7]  # order of a quaternion in a row


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
    """A text file -> camera-to-world poses at increasing times.

    Rows are TUM's, also as CSV and with a header; TUM's after a counter; EuRoC's of 17 columns, or of 8 with a header
    that has the quaternion's w first; KITTI's of 12 numbers or 4x4 matrices of 16, one a frame at the frames' times_s,
    or after a time. Rows with NaN, infinite values or a zero quaternion and repeated times are dropped with a warning;
    rows out of order are sorted. Raises DatasetError for a malformed row (file and line), or when no row is usable.
    """
    lines, values = _pose_rows(path, times_s)
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
    values[:, 0] *= seconds_in(values[:, 0], str(path))
    _, unique = np.unique(values[:, 0], return_index=True)  # sorts as well
    if len(unique) < len(values):
        _log.warning("%s: dropped %d rows whose timestamp had come before", path, len(values) - len(unique))
    return trajectory_from_rows(values[unique])


def _pose_rows(path: Path, times_s: Sequence[float] | None) -> tuple[list[int], NDArray[np.float64]]:
    """Line numbers [N] and rows [N, 8] of TUM's order."""
    rows = read_rows(path, DatasetError)
    if rows and len(rows[0].fields) >= 8 and not any(_is_number(field) for field in rows[0].fields):
        rows = rows[1:]  # a header
    lines = [row.line for row in rows]
    width = Counter(len(row.fields) for row in rows).most_common(1)[0][0] if rows else 8
    if width not in (8, 9, _KITTI, _TIMED_KITTI, _SQUARE, _EUROC):
        width = 8
    table = _numbers(path, rows, width)
    if width == 9 and np.array_equal(np.diff(table[:, 0]), np.ones(len(table) - 1)):
        _log.warning("%s: its rows begin with a counter, which is passed over", path)
        table = table[:, 1:]
    if width == 8 or table.shape[1] == 8:
        return lines, table[:, _SCALAR_FIRST if _header_has_w_first(path) else _SCALAR_LAST]
    if width == _EUROC:
        return lines, table[:, _SCALAR_FIRST]
    if width == _TIMED_KITTI:
        return lines, rows_of_matrices(table[:, 0], table[:, 1:])
    if width in (_KITTI, _SQUARE):
        return lines, rows_of_matrices(_times_of_rows(path, len(table), times_s), table[:, :12])
    raise DatasetError(f"{path}:{lines[0]}: expected {_EXPECTED}, found {rows[0].text[:60]!r}")


def _numbers(path: Path, rows: Sequence[Row], width: int) -> NDArray[np.float64]:
    values = np.empty((len(rows), width))
    for k, row in enumerate(rows):
        try:
            values[k] = [float(field) for field in row.fields]
        except ValueError:
            expected = _EXPECTED if width == 8 else f"{width} numbers, as in most rows"
            raise DatasetError(f"{path}:{row.line}: expected {expected}, found {row.text[:60]!r}") from None
    return values


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _times_of_rows(path: Path, count: int, times_s: Sequence[float] | None) -> NDArray[np.float64]:
    if times_s is None or len(times_s) != count:
        frames = "the frames are not known here" if times_s is None else f"there are {len(times_s)} frames"
        raise DatasetError(
            f"{path}: {count} rows of matrices, as KITTI has them, without times, but {frames}; put a time first in "
            "each row"
        )
    return np.asarray(times_s, np.float64)


def _header_has_w_first(path: Path) -> bool:
    """Whether the first line, also as a comment, names the quaternion's w before its x, as EuRoC's does."""
    with path.open(encoding="utf-8-sig") as file:
        line = file.readline(1000).lower()
    w, x = (re.search(rf"\bq\w*_?{axis}\b", line) for axis in "wx")
    return bool(w and x and w.start() < x.start())
