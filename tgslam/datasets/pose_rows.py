"""Camera-to-world matrices as recordings store them: text files, one a frame or all in one, and other axes."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tgslam.errors import DatasetError
from tgslam.files.tum_text import trajectory_from_rows, usable_pose_rows
from tgslam.geometry import quat_wxyz_from_matrices
from tgslam.types import Matrix4, Trajectory

_log = logging.getLogger(__name__)
_RIGID = 0.02  # of R R^T from the identity, beyond which a matrix is no pose
# Cameras whose y axis points up and whose z axis points back, as OpenGL's and ARKit's do, to ours
OPENGL_CAMERA: Matrix4 = np.diag([1.0, -1.0, -1.0, 1.0])


def rows_of_matrices(times_s: ArrayLike, matrices: ArrayLike) -> NDArray[np.float64]:
    """Matrices [N, >= 12], row by row, at times [N] s -> rows [N, 8] of TUM's order; NaN for what is no rigid motion.

    A matrix may have a fourth row.
    """
    T = np.asarray(matrices, np.float64).reshape(len(np.asarray(times_s)), -1)[:, :12].reshape(-1, 3, 4)
    R = T[..., :3]
    with np.errstate(invalid="ignore", over="ignore"):
        near = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(axis=(1, 2)) <= _RIGID
        rigid = np.isfinite(T).all(axis=(1, 2)) & near
        rigid &= np.linalg.det(np.where(rigid[:, None, None], R, np.eye(3))) > 0
    rows = np.full((len(T), 8), np.nan)
    rows[:, 0] = times_s
    rows[rigid, 1:4] = T[rigid, :, 3]
    if rigid.any():
        rows[rigid, 4:] = quat_wxyz_from_matrices(R[rigid])[:, [1, 2, 3, 0]]
    return rows


def trajectory_of_matrices(times_s: Sequence[float], matrices: ArrayLike, name: str) -> Trajectory:
    """Camera-to-world matrices [N, 4, 4], or [N, 3, 4], of frames at increasing times.

    Those that are no rigid motion, which is how recordings say that they were lost, are left out with a warning.
    Raises DatasetError, which names the file, when none is left.
    """
    rows = rows_of_matrices(times_s, matrices)
    usable = usable_pose_rows(rows)
    if not usable.any():
        raise DatasetError(f"{name}: none of its {len(rows)} poses is a rigid motion; remove it to run without poses")
    if not usable.all():
        _log.warning("%s: %d of %d poses are no rigid motion and are left out", name, (~usable).sum(), len(rows))
    return trajectory_from_rows(rows[usable])


def read_matrix(path: Path, shape: tuple[int, int] = (4, 4)) -> NDArray[np.float64]:
    """A text file of one matrix. Raises DatasetError for other numbers than that many."""
    numbers = read_numbers(path)
    if numbers.size != shape[0] * shape[1]:
        raise DatasetError(f"{path}: expected {shape[0]}x{shape[1]} numbers, found {numbers.size}; get the file again")
    return numbers.reshape(shape)


def read_numbers(path: Path) -> NDArray[np.float64]:
    """All numbers of a text file, with blanks or commas between them. Raises DatasetError."""
    try:
        text = path.read_text(encoding="utf-8-sig")
        return np.array([float(word) for word in text.replace(",", " ").split()])
    except OSError as cause:
        raise DatasetError(f"{path}: cannot be read ({cause.strerror})") from cause
    except ValueError as cause:
        reason = "it is not UTF-8 text" if isinstance(cause, UnicodeDecodeError) else cause
        raise DatasetError(f"{path}: expected numbers only ({reason})") from cause


def poses_of_files(paths: Sequence[Path], times_s: Sequence[float], axes: Matrix4) -> Callable[[], Trajectory | None]:
    """Reads a 4x4 matrix a frame from text files when it is called; None if there is no such file at all.

    Frames without a file have no pose. axes: of our camera in the recording's, so that T_wc = T axes.
    """

    def read() -> Trajectory | None:
        found = [k for k, path in enumerate(paths) if path.is_file()]
        if not found:
            return None
        matrices = np.stack([read_matrix(paths[k]) for k in found])
        return trajectory_of_matrices([times_s[k] for k in found], turned(matrices, axes), str(paths[found[0]].parent))

    return read


def turned(matrices: NDArray[np.float64], axes: Matrix4) -> NDArray[np.float64]:
    """T axes, of matrices [N, 4, 4] that may hold infinite values."""
    with np.errstate(invalid="ignore"):
        return np.asarray(matrices @ axes)
