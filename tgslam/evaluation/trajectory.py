"""Absolute and relative trajectory error, as the TUM benchmark defines them (rigid alignment, no scale)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tgslam.datasets.time_matching import associate_times
from tgslam.errors import EvaluationError
from tgslam.geometry import inverse, transform_points
from tgslam.types import Matrix4, Trajectory

_MIN_MATCHES = 3  # fewer camera centres align on anything


@dataclass(frozen=True)
class AteResult:
    """Distances between estimated and true camera centres, in metres, after alignment."""

    rmse_m: float
    mean_m: float
    median_m: float
    max_m: float
    matched: int  # poses compared
    T_alignment: Matrix4  # maps the estimate's world to the ground truth's


@dataclass(frozen=True)
class RpeResult:
    """Drift over a fixed number of frames."""

    trans_rmse_m: float
    rot_rmse_deg: float
    pairs: int  # relative motions compared


def associate(estimate: Trajectory, groundtruth: Trajectory, tolerance_s: float) -> tuple[Trajectory, Trajectory]:
    """The poses of both that belong together: one to one, closest in time first, at most `tolerance_s` apart.

    Returns (estimate, groundtruth) of equal length, in order of time; each keeps its own timestamps. Raises
    EvaluationError when no pose has a partner.
    """
    i, j = associate_times(estimate.timestamps_s, groundtruth.timestamps_s, tolerance_s)
    if not len(i):
        raise EvaluationError(
            f"none of {len(estimate)} poses is within {tolerance_s:g} s of the ground truth's {len(groundtruth)}"
            f"{_span('; the estimate', estimate)}{_span(', the ground truth', groundtruth)}"
            "; check the file, or raise evaluation.truth_tolerance_s"
        )
    return _selected(estimate, i), _selected(groundtruth, j)


def align_se3(estimate_points: ArrayLike, reference_points: ArrayLike) -> Matrix4:
    """The rigid transform [4, 4] that moves points [N, 3] m onto reference points [N, 3] m with least square error.

    The rotation is always proper. Where the points leave it open (all on a line, or at one place), one of the best is
    returned: the error is the same for all of them. Raises EvaluationError for no points, shapes that differ, or
    values that are not finite.
    """
    source = np.asarray(estimate_points, np.float64)
    target = np.asarray(reference_points, np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3 or not len(source):
        raise EvaluationError(f"alignment needs two equal sets of 3D points, not {source.shape} and {target.shape}")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise EvaluationError("alignment needs finite points; the trajectory holds NaN or infinite positions")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - target_mean).T @ (source - source_mean))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    T[:3, 3] = target_mean - T[:3, :3] @ source_mean
    return T


def ate(estimate: Trajectory, groundtruth: Trajectory, tolerance_s: float) -> AteResult:
    """Absolute trajectory error of camera-to-world poses after SE(3) alignment of the camera centres.

    Raises EvaluationError with fewer than 3 poses to compare.
    """
    matched, truth = associate(estimate, groundtruth, tolerance_s)
    if len(matched) < _MIN_MATCHES:
        raise EvaluationError(
            f"ATE needs {_MIN_MATCHES} poses that have ground truth, but only {len(matched)} of {len(estimate)} have"
        )
    centres, true_centres = matched.T_wc[:, :3, 3], truth.T_wc[:, :3, 3]
    T = align_se3(centres, true_centres)
    errors_m = np.linalg.norm(transform_points(T, centres) - true_centres, axis=1)
    return AteResult(
        rmse_m=_rms(errors_m),
        mean_m=float(errors_m.mean()),
        median_m=float(np.median(errors_m)),
        max_m=float(errors_m.max()),
        matched=len(matched),
        T_alignment=T,
    )


def align_poses(estimate: Trajectory, groundtruth: Trajectory, tolerance_s: float) -> Matrix4:
    """T_ge [4, 4] from the estimate's world to the true one that whole poses agree on best, not only camera centres.

    A camera that hardly moves says little of how the worlds are turned by where it is, but all by where it looks.
    The rotation is the chordal mean of R_true R_estimated^T. Raises EvaluationError without a pose to compare.
    """
    matched, truth = associate(estimate, groundtruth, tolerance_s)
    turns = truth.T_wc[:, :3, :3] @ np.swapaxes(matched.T_wc[:, :3, :3], 1, 2)
    left, _, right = np.linalg.svd(turns.sum(axis=0))
    T = np.eye(4)
    T[:3, :3] = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    T[:3, 3] = np.mean(truth.T_wc[:, :3, 3] - matched.T_wc[:, :3, 3] @ T[:3, :3].T, axis=0)
    return T


def rpe(estimate: Trajectory, groundtruth: Trajectory, tolerance_s: float, delta_frames: int = 1) -> RpeResult:
    """Relative pose error over every pair of matched poses that are `delta_frames` matches apart.

    Needs no alignment: the motion from pose i to pose i + delta is compared with the true one. Raises EvaluationError
    when no such pair exists.
    """
    matched, truth = associate(estimate, groundtruth, tolerance_s)
    if delta_frames < 1 or len(matched) <= delta_frames:
        raise EvaluationError(
            f"RPE over {delta_frames} frames needs more than that many poses with ground truth, and there are "
            f"{len(matched)}; lower evaluation.rpe_delta_frames"
        )
    motion = inverse(matched.T_wc[:-delta_frames]) @ matched.T_wc[delta_frames:]
    true_motion = inverse(truth.T_wc[:-delta_frames]) @ truth.T_wc[delta_frames:]
    error = inverse(true_motion) @ motion
    if not np.isfinite(error).all():
        raise EvaluationError("RPE needs finite poses; the trajectory holds NaN or infinite values")
    return RpeResult(
        trans_rmse_m=_rms(np.linalg.norm(error[:, :3, 3], axis=1)),
        rot_rmse_deg=_rms(np.degrees(_rotation_angles(error[:, :3, :3]))),
        pairs=len(error),
    )


def _rotation_angles(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles [N] in rad of rotations [N, 3, 3], from sine and cosine: exact for the small ones too."""
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    return np.arctan2(np.linalg.norm(axis, axis=1), np.trace(R, axis1=1, axis2=2) - 1.0)


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _selected(trajectory: Trajectory, indices: NDArray[np.intp]) -> Trajectory:
    return Trajectory(trajectory.timestamps_s[indices], trajectory.T_wc[indices])


def _span(label: str, trajectory: Trajectory) -> str:
    if not len(trajectory):
        return f"{label} is empty"
    return f"{label} covers {trajectory.timestamps_s[0]:.3f} to {trajectory.timestamps_s[-1]:.3f} s"
