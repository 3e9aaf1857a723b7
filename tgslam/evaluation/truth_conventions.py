"""Ground truth in another convention than camera to world: told by what would make it fit an estimate.

A wrong convention gives errors that look like a bad reconstruction. One that fits the estimate far better once it is
undone is not chance: neither turns nor shifts of a trajectory agree by accident.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.errors import EvaluationError
from tgslam.evaluation.trajectory import align_se3, associate
from tgslam.geometry import inverse, matrix_from_quat_wxyz, orthonormalized, quat_wxyz_from_matrices, so3_log
from tgslam.types import Trajectory

Poses = NDArray[np.float64]

_LEAST_POSES = 8
_LEAST_TURN_RAD = 0.1  # that the camera turns within the trajectory; less tells no convention
_LEAST_EXTENT_M = 0.02
_WRONG_TURN_RAD, _WRONG_SHIFT = (
    0.1,
    0.15,
)  # misfits beyond which a convention is in doubt; shifts as parts of the extent
_RIGHT_TURN_RAD, _RIGHT_SHIFT = 0.06, 0.08  # and below which one is believed
_BETTER = 0.3  # of the misfit is left by one that is believed
_SCALES = (0.7, 1.4)  # outside of it, lengths differ
_OPENGL = np.diag([1.0, -1.0, -1.0])
_BODY = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # x forward, y right, z down, in the camera's
_SAME_AXES_RAD = 0.2
_SECOND_AXIS = 0.1  # of the turns about the first, for both to say how the camera's axes lie


@dataclass(frozen=True)
class _Misfit:
    turn_rad: float  # rms
    shift: float  # rms over the extent of the estimate


def likely_mistake(estimate: Trajectory, groundtruth: Trajectory, tolerance_s: float) -> str | None:
    """What seems wrong with the convention of ground truth; None where it fits, or where too little says so."""
    try:
        matched, truth = associate(estimate, groundtruth, tolerance_s)
    except EvaluationError:
        return None
    E, G = matched.T_wc, truth.T_wc
    if len(E) < _LEAST_POSES or _extent_m(E) < _LEAST_EXTENT_M:
        return None
    found = _misfit(E, G)
    if found.turn_rad < _WRONG_TURN_RAD and found.shift < _WRONG_SHIFT:
        return None
    turns = max(float(np.linalg.norm(so3_log(E[0, :3, :3].T @ T[:3, :3]))) for T in E)
    for said, corrected in _corrections(E, G):
        if turns < _LEAST_TURN_RAD and "lengths" not in said:
            continue
        misfit = _misfit(E, corrected)
        right = misfit.turn_rad < _RIGHT_TURN_RAD and misfit.shift < _RIGHT_SHIFT
        if right and (misfit.turn_rad < _BETTER * found.turn_rad or misfit.shift < _BETTER * found.shift):
            return said
    return None


def _corrections(E: Poses, G: Poses) -> Iterator[tuple[str, Poses]]:
    """What may be wrong with true poses [N, 4, 4], and these put right; the likeliest first."""
    yield "it goes from world to camera: invert its poses", inverse(G)
    reordered = _with_w_first(G)
    yield "its quaternions have w first: put qw last", reordered
    yield "it goes from world to camera, and its quaternions have w first", inverse(reordered)
    for said, poses in (("", G), ("it goes from world to camera, and ", inverse(G))):
        X = _axes(E, poses)
        if X is None:
            continue
        corrected = poses.copy()
        corrected[:, :3, :3] = poses[:, :3, :3] @ X.T
        yield f"{said}the axes of its camera are {_named(X)}, not x right, y down, z forward", corrected
    factor = _scale(E, G)
    if not _SCALES[0] < factor < _SCALES[1]:
        scaled = G.copy()
        scaled[:, :3, 3] /= factor
        yield (
            (
                f"its lengths are {float(f'{factor:.2g}'):g} times those of the estimate: it is in another unit than "
                "metres, or dataset.depth_scale is wrong"
            ),
            scaled,
        )


def _misfit(E: Poses, G: Poses) -> _Misfit:
    """Of poses [N, 4, 4], after the best alignment of turns and of centres each."""
    turns = G[:, :3, :3] @ E[:, :3, :3].transpose(0, 2, 1)
    mean = _rotation(turns.sum(axis=0))
    angles = [float(np.linalg.norm(so3_log(mean.T @ turn))) for turn in turns]
    T = align_se3(E[:, :3, 3], G[:, :3, 3])
    # where the camera hardly turns about what it sees, centres on a line fit any convention: they take the turns' word
    shifts = E[:, :3, 3] @ mean.T - G[:, :3, 3] if _on_a_line(E) else E[:, :3, 3] @ T[:3, :3].T - G[:, :3, 3]
    off_m = np.linalg.norm(shifts - shifts.mean(axis=0), axis=1)
    return _Misfit(_rms(np.array(angles)), _rms(off_m) / _extent_m(E))


def _on_a_line(E: Poses) -> bool:
    spread = np.linalg.svd(E[:, :3, 3] - E[:, :3, 3].mean(axis=0), compute_uv=False)
    return bool(spread[1] < 0.1 * spread[0])


def _axes(E: Poses, G: Poses) -> NDArray[np.float64] | None:
    """[3, 3] X that turns the motions of the estimated camera into those of the true one: g = X^T e.

    None where the camera turns about one axis only, which leaves it open.
    """
    step = max(1, len(E) // 10)
    e, g = (np.stack([so3_log(R[k, :3, :3].T @ R[k + step, :3, :3]) for k in range(len(E) - step)]) for R in (E, G))
    turned = np.linalg.svd(e, compute_uv=False)
    return _rotation(e.T @ g) if turned[1] > _SECOND_AXIS * turned[0] else None


def _named(X: NDArray[np.float64]) -> str:
    for name, axes in (("those of OpenGL (y up, z backward)", _OPENGL), ("a body's (x forward, z down)", _BODY)):
        if float(np.linalg.norm(so3_log(axes.T @ X))) < _SAME_AXES_RAD:
            return name
    return f"turned by {np.rad2deg(np.linalg.norm(so3_log(X))):.0f} degrees"


def _with_w_first(G: Poses) -> Poses:
    """Poses whose quaternions were read as x, y, z, w, but are w, x, y, z."""
    w, x, y, z = quat_wxyz_from_matrices(G[:, :3, :3]).T
    read = np.stack([x, y, z, w], axis=1)  # in the order of the file
    result = G.copy()
    result[:, :3, :3] = matrix_from_quat_wxyz(read)
    return result


def _scale(E: Poses, G: Poses) -> float:
    """Lengths of the truth over those of the estimate."""
    return _extent_m(G) / max(_extent_m(E), 1e-12)


def _extent_m(poses: Poses) -> float:
    centres = poses[:, :3, 3]
    return _rms(np.linalg.norm(centres - centres.mean(axis=0), axis=1))


def _rotation(M: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation nearest to [3, 3]."""
    T = np.eye(4)
    U, _, Vt = np.linalg.svd(M)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return orthonormalized(T)[:3, :3]


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
