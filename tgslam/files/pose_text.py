"""Camera poses as people have them: TUM text, CSV with a header, EuRoC, KITTI's 3x4 rows, 4x4 matrices, arrays."""

from __future__ import annotations

import logging
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.errors import TgslamError
from tgslam.files.clock import ticks_per_second, unit_name
from tgslam.files.tum_text import Row, read_rows, usable_pose_rows
from tgslam.geometry import matrix_from_quat_wxyz, orthonormalized

_log = logging.getLogger(__name__)
_TUM_FIELDS = "timestamp tx ty tz qx qy qz qw"
_KNOWN = (
    "also known are 12 numbers (KITTI's 3x4), 16 (4x4), either of them after a time, 4x4 matrices in four lines each, "
    "and columns that a header names"
)
_WIDTHS = (9, 12, 13, 16, 17)  # besides TUM's 8
_NOT_ORTHONORMAL = 0.05  # largest entry of R^T R - I: rounded rotations are below, scaled and sheared ones above
_POSE_ROLES = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
_TIMES = {"t", "time", "times", "timestamp", "timestamps", "stamp", "ts", "time_s", "timestamp_s", "sec", "seconds"}
_TURNS = ("q", "rot", "orient")
_PLACES = {"", "t", "p", "pos", "position", "trans", "translation"}


@dataclass(frozen=True)
class PoseTable:
    """Camera-to-world poses in the order of the file."""

    lines: list[int]  # [N] where they stand, counted from 1
    times_s: NDArray[np.float64] | None  # [N]; None: pose number k is that of frame number k
    T_wc: NDArray[np.float64]  # [N, 4, 4]; the identity where it cannot be used
    usable: NDArray[np.bool_]  # [N] finite numbers, and a rotation


def read_pose_table(path: Path, error: type[TgslamError]) -> PoseTable:
    """A file of poses, whose layout is told from its columns. Times in nanoseconds and such become seconds.

    Raises `error`, with file and line, for a row that does not go with the others, and for columns that are not known.
    """
    if path.suffix == ".npy":
        values = _read_array(path, error)
        lines, columns = list(range(1, len(values) + 1)), None
    else:
        rows = read_rows(path, error)
        columns = _named_columns(path, rows)
        rows = rows[1:] if _is_header(rows) else rows
        values, lines = _numbers(path, rows, error), [row.line for row in rows]
        if values.shape[1] == 4 and len(values) and _is_stack(values):
            values, lines = values.reshape(-1, 16), lines[::4]
    return _table(path, values, lines, columns, error)


def _table(
    path: Path,
    values: NDArray[np.float64],
    lines: list[int],
    columns: list[int] | None,
    error: type[TgslamError],
) -> PoseTable:
    width = values.shape[1]
    if width == 9 and columns is None and np.array_equal(np.diff(values[:, 0]), np.ones(len(values) - 1)):
        _log.warning("%s: its rows begin with a counter, which is passed over", path)
        values, width = values[:, 1:], 8
    if columns is not None:
        values, width = values[:, columns], 8
    if width == 8 or not len(values):
        times, (T_wc, usable) = values[:, 0], _from_quaternions(values if len(values) else np.empty((0, 8)))
    elif width in (12, 16):
        times, (T_wc, usable) = None, _from_matrices(values)
    elif width == 13 or (width == 17 and np.allclose(values[:, 13:], (0, 0, 0, 1), atol=1e-6)):
        times, (T_wc, usable) = values[:, 0], _from_matrices(values[:, 1:])
    elif width == 17:  # EuRoC's, with velocity and biases
        times, (T_wc, usable) = values[:, 0], _from_quaternions(values[:, [0, 1, 2, 3, 5, 6, 7, 4]])
    else:
        raise error(f"{path}:{lines[0]}: expected 8 numbers ({_TUM_FIELDS}), found {width}; {_KNOWN}")
    if times is not None:
        usable = usable & np.isfinite(times)
        ticks = ticks_per_second(times)
        if ticks != 1.0:
            _log.warning("%s: its times are in %s, and are read so", path, unit_name(ticks))
        times = times / ticks
    return PoseTable(lines, times, T_wc, usable)


def _from_quaternions(rows: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Poses [N, 4, 4] of rows [N, 8], and which are usable [N]."""
    usable = usable_pose_rows(rows)
    T_wc = np.tile(np.eye(4), (len(rows), 1, 1))
    T_wc[usable, :3, :3] = matrix_from_quat_wxyz(rows[usable][:, [7, 4, 5, 6]])
    T_wc[usable, :3, 3] = rows[usable, 1:4]
    return T_wc, usable


def _from_matrices(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Poses [N, 4, 4] of matrices by rows [N, 12 or 16], and which are usable [N]: not all -inf, as for lost frames."""
    T_wc = np.tile(np.eye(4), (len(values), 1, 1))
    T_wc[:, :3] = values[:, :12].reshape(-1, 3, 4)
    usable = np.asarray(np.isfinite(T_wc).all(axis=(1, 2)))
    T_wc[~usable] = np.eye(4)
    R = T_wc[:, :3, :3]
    skewed = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2))
    usable &= (skewed < _NOT_ORTHONORMAL) & (np.linalg.det(R) > 0)
    for k in np.flatnonzero(usable):
        T_wc[k] = orthonormalized(T_wc[k])
    T_wc[~usable] = np.eye(4)
    return T_wc, usable


def _read_array(path: Path, error: type[TgslamError]) -> NDArray[np.float64]:
    try:
        array = np.load(path, allow_pickle=False)
        values = np.asarray(array, np.float64)
    except (OSError, ValueError, TypeError) as cause:
        raise error(f"{path}: not a NumPy array of numbers ({cause})") from cause
    if values.ndim == 3 and values.shape[1:] in ((3, 4), (4, 4)):
        values = values.reshape(len(values), -1)
    if values.ndim != 2:
        raise error(f"{path}: an array of shape {list(array.shape)} holds no poses; expected [N, 4, 4] or [N, 3, 4]")
    return values


def _numbers(path: Path, rows: list[Row], error: type[TgslamError]) -> NDArray[np.float64]:
    """[N, columns] of the rows; each must have as many as most."""
    count = Counter(len(row.fields) for row in rows).most_common(1)[0][0] if rows else 8
    values = np.empty((len(rows), count))
    for k, (line, fields, text) in enumerate(rows):
        try:
            values[k] = [float(field) for field in fields]
        except ValueError:
            expected = f"{count} numbers, as in most rows" if count in _WIDTHS else f"8 numbers ({_TUM_FIELDS})"
            raise error(f"{path}:{line}: expected {expected}, found {text[:60]!r}") from None
    return values


def _is_stack(values: NDArray[np.float64]) -> bool:
    return len(values) % 4 == 0 and bool(np.allclose(values[3::4], (0.0, 0.0, 0.0, 1.0), atol=1e-6))


def _is_header(rows: list[Row]) -> bool:
    """Whether the first row, which is no comment, has words where the second has numbers."""
    return len(rows) > 1 and not any(map(_is_number, rows[0].fields)) and all(map(_is_number, rows[1].fields))


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _named_columns(path: Path, rows: list[Row]) -> list[int] | None:
    """Where time and pose stand, by the header in the first line, in the order of TUM's fields; None without one."""
    first = path.read_text(encoding="utf-8-sig").partition("\n")[0].strip().lstrip("#")
    names = first.split(",") if "," in first else first.split()
    width = max((len(row.fields) for row in rows[:2]), default=0)
    if len(names) != width or all(_is_number(name) for name in names):
        return None
    roles = [_role(name) for name in names]
    wanted = ("time", *_POSE_ROLES)
    return [roles.index(role) for role in wanted] if set(wanted) <= set(roles) else None


def _role(name: str) -> str:
    """What a column holds: "time", one of `_POSE_ROLES`, or something else."""
    word = re.sub(r"\[.*?\]|\(.*?\)", "", name).strip().lower()
    if word in _TIMES:
        return "time"
    stem, axis = re.sub(r"[\W_]+$", "", word[:-1]), word[-1:]
    if axis in ("x", "y", "z", "w") and stem.startswith(_TURNS):
        return f"q{axis}"
    if axis in ("x", "y", "z") and (stem in _PLACES or stem.startswith("p_")):
        return f"t{axis}"
    return word
