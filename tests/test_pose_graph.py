"""The pose graph against known truth: conventions, landmarks, closures, robustness, errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

pytest.importorskip("gtsam")

import gtsam

from tests.plane_worlds import Box, odometry, position_errors_m, shifted, walking
from tests.test_plane_estimate import random_plane, random_pose
from tgslam.config.schema import ClosureConfig
from tgslam.geometry import inverse, se3_exp, se3_log
from tgslam.planes.estimate import PlaneEstimate
from tgslam.pose_graph import GraphEstimate, PoseGraph, _PlaneError
from tgslam.types import RelativePose

seeds = st.integers(0, 2**32 - 1)
CORRIDOR = Box((2.0, 2.5, 20.0))
ROOM = Box((4.0, 2.5, 5.0))


def chain(graph: PoseGraph, first: np.ndarray, motions: list[RelativePose]) -> None:
    """Add keyframes 0, 1, ... joined by the motions."""
    graph.add_keyframe(0, first, None, None)
    for k, motion in enumerate(motions):
        graph.add_keyframe(k + 1, np.eye(4), k, motion)


def solved(
    config: ClosureConfig,
    truth: list[np.ndarray],
    motions: list[RelativePose],
    views: list[dict[int, PlaneEstimate]],
) -> GraphEstimate:
    """Keyframe by keyframe, with planes as landmarks."""
    graph = PoseGraph(config)
    for k, view in enumerate(views):
        if k == 0:
            graph.add_keyframe(0, truth[0], None, None)
        else:
            graph.add_keyframe(k, truth[k], k - 1, motions[k - 1])
        for plane_id, plane in view.items():
            graph.add_plane_observation(k, plane_id, plane)
        estimate = graph.optimise()
    return estimate


def numeric(function, size: int, step: float = 1e-6) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Derivative of a vector function at zero."""
    return np.stack([(function(d) - function(-d)) / (2 * step) for d in step * np.eye(size)], axis=1)


@given(seeds)
def test_the_error_of_a_plane_is_in_standard_deviations_and_its_jacobians_are_right(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_cw, plane_w = random_pose(rng), random_plane(rng)
    seen = shifted(plane_w.transformed(T_cw), 1e-2 * rng.standard_normal(3))
    error = _PlaneError((0, 1), seen)
    pose, landmark = gtsam.Pose3(inverse(T_cw)), gtsam.OrientedPlane3(*plane_w.normal, float(plane_w.offset_m))

    def at(xi: np.ndarray, turn: np.ndarray, jacobians: list[np.ndarray] | None = None) -> np.ndarray:
        values = gtsam.Values()
        values.insert(0, pose.retract(xi))
        values.insert(1, landmark.retract(turn))
        return error(None, values, jacobians)

    jacobians = [np.zeros((3, 6)), np.zeros((3, 3))]
    at(np.zeros(6), np.zeros(3), jacobians)
    scale = abs(jacobians[0]).max()
    assert_allclose(jacobians[0], numeric(lambda d: at(d, np.zeros(3)), 6), atol=1e-6 * scale)
    assert_allclose(jacobians[1], numeric(lambda d: at(np.zeros(6), d), 3), atol=1e-6 * scale)


@given(seeds)
def test_a_plane_that_is_off_by_its_own_errors_has_their_mahalanobis_length(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_cw, truth = random_pose(rng), random_plane(rng, sigma=1e-3)
    local = truth.transformed(T_cw)
    offset = np.linalg.cholesky(local.covariance) @ rng.standard_normal(3)
    predicted = shifted(local, offset).transformed(inverse(T_cw))
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3(inverse(T_cw)))
    values.insert(1, gtsam.OrientedPlane3(*predicted.normal, float(predicted.offset_m)))
    found = _PlaneError((0, 1), local)(None, values, None)
    expected = offset @ np.linalg.solve(local.covariance, offset)
    assert_allclose(found @ found, expected, rtol=0.1)


def test_information_speaks_of_left_perturbations_of_the_motion() -> None:
    """Two odometry edges disagree; the weighted mean in the tangent of T_ji is the answer."""
    rng = np.random.default_rng(0)
    T_ji = random_pose(rng)
    parts = [rng.standard_normal((6, 6)) for _ in range(2)]
    informations = [1e4 * (part @ part.T + np.eye(6)) for part in parts]
    errors = [1e-4 * rng.standard_normal(6) for _ in range(2)]
    first, second = (
        RelativePose(se3_exp(e) @ T_ji, information) for e, information in zip(errors, informations, strict=True)
    )
    graph = PoseGraph(ClosureConfig(robust="none"))
    graph.add_keyframe(0, random_pose(rng), None, None)
    graph.add_keyframe(1, np.eye(4), 0, first)
    graph.add_closure(0, 1, second)
    graph.optimise()
    found, covariance = graph.relative(0, 1)
    mean = np.linalg.solve(sum(informations), sum(A @ e for A, e in zip(informations, errors, strict=True)))
    assert_allclose(se3_log(found @ inverse(T_ji)), mean, atol=2e-7)
    assert_allclose(covariance, np.linalg.inv(sum(informations)), rtol=1e-3, atol=1e-9)
    back, turned = graph.relative(1, 0)
    assert_allclose(back, inverse(found), atol=1e-9)
    assert np.linalg.eigvalsh(turned).min() > 0


def test_a_closure_leaves_alone_what_it_does_not_know() -> None:
    information = np.diag([1e6, 1e6, 1e6, 1e6, 1e6, 0.0])
    step = RelativePose(se3_exp([0, 0, 0, 0, 0, -1.0]), np.diag([1e4] * 6))
    graph = PoseGraph(ClosureConfig())
    chain(graph, np.eye(4), [step] * 4)
    graph.add_closure(0, 4, RelativePose(se3_exp([0, 0, 0, 0.01, 0, -3.0]), information))
    found = graph.optimise().T_cw[4]
    assert_allclose(found[2, 3], -4.0, atol=1e-3)
    assert_allclose(found[0, 3], 0.01, atol=1e-3)


@pytest.mark.parametrize("solver", ["incremental", "batch"])
@pytest.mark.parametrize("seed", range(3))
def test_planes_seen_again_straighten_a_corridor(solver: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = walking(CORRIDOR.size_m, 60)
    motions = odometry(truth, rng)
    views = [CORRIDOR.views(T, rng) for T in truth]
    drift = position_errors_m(solved(ClosureConfig(), truth, motions, [{}] * 60).T_cw, truth)
    graph = PoseGraph(ClosureConfig(solver=solver))
    graph.add_keyframe(0, truth[0], None, None)
    for k, motion in enumerate(motions):
        graph.add_keyframe(k + 1, truth[k + 1], k, motion)
    for k, view in enumerate(views):
        for plane_id, plane in view.items():
            graph.add_plane_observation(k, plane_id, plane)
    corrected = position_errors_m(graph.optimise().T_cw, truth)
    print(seed, solver, drift[-1], corrected[-1], np.sqrt((drift**2).mean()), np.sqrt((corrected**2).mean()))
    assert np.sqrt((corrected**2).mean()) < 0.5 * np.sqrt((drift**2).mean())
