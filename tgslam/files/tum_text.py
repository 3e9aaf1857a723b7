"""The TUM benchmark's text files: rows of fields after a timestamp, `#` comments, blanks or commas between fields."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tgslam.errors import TgslamError
from tgslam.geometry import matrix_from_quat_wxyz
from tgslam.types import Trajectory

_POSE_FIELDS = "timestamp tx ty tz qx qy qz qw"


class Row(NamedTuple):
    """One line that holds data."""

    line: int  # counted from 1
    fields: list[str]
    text: str  # the whole of it


def read_rows(path: Path, error: type[TgslamError]) -> list[Row]:
    """The data rows of a text file, comments and empty lines left out. Raises `error` if it cannot be read."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror}); check the path and its permissions") from cause
    except UnicodeDecodeError as cause:
        raise error(f"{path}: not a text file (byte {cause.start} is no UTF-8)") from cause
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if fields and not fields[0].startswith("#"):
            rows.append(Row(number, fields, line.strip()))
    return rows


def read_pose_rows(path: Path, error: type[TgslamError]) -> tuple[list[int], NDArray[np.float64]]:
    """Rows of `timestamp tx ty tz qx qy qz qw` as (line numbers [N], values [N, 8]); values may be NaN or infinite.

    Raises `error`, with file and line, for a row of another shape.
    """
    rows = read_rows(path, error)
    values = np.empty((len(rows), 8))
    for k, (line, fields, _) in enumerate(rows):
        try:
            values[k] = [float(field) for field in fields]
        except ValueError:
            raise error(
                f"{path}:{line}: expected 8 numbers ({_POSE_FIELDS}), found {' '.join(fields)[:60]!r}"
            ) from None
    return [row.line for row in rows], values


def usable_pose_rows(values: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which rows [N, 8] hold a pose: all values finite, and a quaternion that is not zero. -> [N]"""
    finite = np.asarray(np.isfinite(values).all(axis=1))
    return finite & (np.linalg.norm(np.where(finite[:, None], values[:, 4:], 0.0), axis=1) > 1e-6)


def trajectory_from_rows(values: NDArray[np.float64]) -> Trajectory:
    """Usable rows [N, 8] in increasing time -> camera-to-world poses (quaternions are normalised)."""
    T_wc = np.tile(np.eye(4), (len(values), 1, 1))
    T_wc[:, :3, :3] = matrix_from_quat_wxyz(values[:, [7, 4, 5, 6]])
    T_wc[:, :3, 3] = values[:, 1:4]
    return Trajectory(values[:, 0].copy(), T_wc)
