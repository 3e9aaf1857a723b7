"""Ground truth in another convention is named, and one that fits, or that is merely far off, is not."""

from __future__ import annotations

import numpy as np
import pytest

from tgslam.evaluation.truth_conventions import likely_mistake
from tgslam.geometry import inverse, matrix_from_quat_wxyz, quat_wxyz_from_matrices, se3_exp
from tgslam.types import Trajectory

COUNT = 60
TIMES = np.arange(COUNT) / 30.0
WORLD = se3_exp([0.4, -1.0, 0.3, 2.0, -1.0, 0.5])


def walked(noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """A camera that looks about and walks on a curve; errors of so many rad and m."""
    rng, t = np.random.default_rng(seed), np.linspace(0.0, 1.0, COUNT)
    turns = np.stack([0.3 * np.sin(5 * t), 0.8 * t, 0.1 * np.sin(9 * t)], 1)
    places = np.stack([np.sin(3 * t), 0.1 * np.sin(7 * t), 1.5 * t], 1)
    errors = noise * rng.normal(size=(COUNT, 6))
    return np.stack(
        [
            se3_exp([0, 0, 0, *p]) @ se3_exp([*r, 0, 0, 0]) @ se3_exp(e)
            for r, p, e in zip(turns, places, errors, strict=True)
        ]
    )


def said(truth: np.ndarray, estimate: np.ndarray | None = None) -> str | None:
    found = walked(noise=0.005) if estimate is None else estimate
    return likely_mistake(Trajectory(TIMES, found), Trajectory(TIMES, truth), 0.01)


def w_first(poses: np.ndarray) -> np.ndarray:
    """As a reader of x, y, z, w takes a file of w, x, y, z."""
    w, x, y, z = quat_wxyz_from_matrices(poses[:, :3, :3]).T
    result = poses.copy()
    result[:, :3, :3] = matrix_from_quat_wxyz(np.stack([z, w, x, y], 1))
    return result


def with_axes(poses: np.ndarray, X: np.ndarray) -> np.ndarray:
    result = poses.copy()
    result[:, :3, :3] = poses[:, :3, :3] @ X
    return result


TRUE = WORLD @ walked()
OPENGL = np.diag([1.0, -1.0, -1.0])
BODY = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # its axes, in the camera's


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        (inverse(TRUE), "from world to camera: invert"),
        (w_first(TRUE), "w first: put qw last"),
        (w_first(inverse(TRUE)), "world to camera, and its quaternions have w first"),
        (with_axes(TRUE, OPENGL), "axes of its camera are those of OpenGL"),
        (with_axes(TRUE, BODY), "axes of its camera are a body's"),
        (with_axes(TRUE, se3_exp([0, 0, np.pi / 2, 0, 0, 0])[:3, :3]), "turned by 90 degrees"),
        (inverse(with_axes(TRUE, OPENGL)), "axes of its camera are those of OpenGL"),
        (TRUE * np.where(np.arange(4) == 3, 1000.0, 1.0)[None, None] * [[1]], "1000 times"),
        (TRUE * np.where(np.arange(4) == 3, 0.2, 1.0)[None, None] * [[1]], "depth_scale is wrong"),
    ],
)
def test_the_mistake_is_named(truth: np.ndarray, message: str) -> None:
    truth = truth.copy()
    truth[:, 3] = [0.0, 0.0, 0.0, 1.0]
    found = said(truth)
    assert found is not None and message in found


def test_ground_truth_that_fits_is_right() -> None:
    assert said(TRUE) is None
    assert said(TRUE, walked(noise=0.04)) is None


def test_a_run_that_went_wrong_is_not_blamed_on_the_truth() -> None:
    drifted = walked()
    for k in range(COUNT):
        drifted[k] = se3_exp([0.0, 0.03 * k, 0.0, 0.02 * k, 0.0, 0.0]) @ drifted[k]
    assert said(TRUE, drifted) is None
    assert said(TRUE, walked()[np.random.default_rng(1).permutation(COUNT)]) is None


def test_too_little_says_nothing() -> None:
    still = np.tile(np.eye(4), (COUNT, 1, 1))
    assert said(inverse(TRUE), still) is None
    few = Trajectory(TIMES[:5], walked()[:5])
    assert likely_mistake(few, Trajectory(TIMES, inverse(TRUE)), 0.01) is None
    assert likely_mistake(few, Trajectory(TIMES + 100.0, TRUE), 0.01) is None
    straight = np.stack([se3_exp([0, 0, 0, 0.02 * k, 0, 0]) for k in range(COUNT)])
    assert said(WORLD @ straight, straight) is None
