"""The pose graph against known truth: conventions, landmarks, closures, robustness, errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from tests.plane_worlds import Box, odometry, position_errors_m, shifted, turning, walking
from tests.test_plane_estimate import random_plane, random_pose
from tests.tiers import changed
from tgslam.config.graph_settings import ClosureConfig, SolvingSettings
from tgslam.errors import GraphError
from tgslam.geometry import inverse, se3_exp, se3_log
from tgslam.graph.factors import PlaneError, Sighting, whitening
from tgslam.graph.gating import passes
from tgslam.graph.pose_graph import GraphEstimate, PoseGraph
from tgslam.graph.relative import measure
from tgslam.graph.solvers import Change, Incremental, make_solver
from tgslam.graph.structure.candidates import candidates, shared_planes
from tgslam.planes.estimate import PlaneEstimate
from tgslam.relative_motion import Measurement
from tgslam.types import RelativePose

seeds = st.integers(0, 2**32 - 1)
CORRIDOR = Box((2.0, 2.5, 20.0))
ROOM = Box((4.0, 2.5, 5.0))
LANDMARKS = ClosureConfig(formulation="landmarks")


def chain(graph: PoseGraph, first: np.ndarray, motions: list[RelativePose]) -> None:
    """Add keyframes 0, 1, ... joined by the motions."""
    graph.add_first(0, first)
    for k, motion in enumerate(motions):
        graph.add_keyframe(k + 1, {k: motion})


@dataclass
class Corruption:
    """Moves some closures away from the truth."""

    share: float
    rng: np.random.Generator
    count: int = 0

    def __call__(self, measured: Measurement) -> Measurement:
        if self.rng.random() >= self.share:
            return measured
        self.count += 1
        xi = self.rng.standard_normal(6) * [0.05, 0.05, 0.05, 0.2, 0.2, 0.2]
        return replace(measured, T_ji=se3_exp(xi) @ measured.T_ji)


def replace_planes(graph: PoseGraph, views: list[dict[int, PlaneEstimate]]) -> None:
    """All sightings anew, by keyframe and plane."""
    for plane_id in sorted({*graph.estimate().plane_ids.tolist(), *(i for seen in views for i in seen)}):
        graph.replace_plane(plane_id, {k: seen[plane_id] for k, seen in enumerate(views) if plane_id in seen})


World = tuple[list[np.ndarray], list[RelativePose], list[dict[int, PlaneEstimate]]]


def simulated(box: Box, path: Callable[..., list[np.ndarray]], count: int, seed: int, noise: float = 1.0) -> World:
    """True T_cw, odometry, and what each view says of the planes."""
    rng = np.random.default_rng(seed)
    truth = path(box.size_m, count)
    return truth, odometry(truth, rng, noise), [box.views(T, rng, noise) for T in truth]


def run(
    config: ClosureConfig,
    truth: list[np.ndarray],
    motions: list[RelativePose],
    views: list[dict[int, PlaneEstimate]],
    corrupt: Callable[[Measurement], Measurement] = lambda measured: measured,
    gated: bool = True,
) -> GraphEstimate:
    """Keyframe by keyframe, as the system does, with planes as landmarks, closures, or both."""
    graph, acceptance = PoseGraph(config.expert.solving), config.expert.acceptance
    for k, seen in enumerate(views):
        if k == 0:
            graph.add_first(0, truth[0])
        else:
            graph.add_keyframe(k, {k - 1: motions[k - 1]})
        if config.formulation != "closures":
            graph.add_plane_observations([Sighting(k, plane_id, plane) for plane_id, plane in seen.items()])
        estimate = graph.optimise()
        if config.formulation != "landmarks" and k and k % config.interval == 0:
            T_ji = dict(enumerate(estimate.T_cw[k] @ inverse(estimate.T_cw[:k])))
            for found in candidates(seen, dict(enumerate(views[:k])), T_ji, config):
                i = found.keyframe
                measured = corrupt(measure(shared_planes(views[i], seen)[1], T_ji[i], acceptance))
                if not gated or passes(measured, *graph.relative(i, k), acceptance.gate_probability):
                    graph.add_closure(i, k, measured.motion)
            estimate = graph.optimise()
    return estimate


def rms_m(found: GraphEstimate, truth: list[np.ndarray]) -> float:
    """Of the positions."""
    return float(np.sqrt(np.mean(position_errors_m(found.T_cw, truth) ** 2)))


def heights_and_ground(found: GraphEstimate, truth: list[np.ndarray]) -> tuple[float, float]:
    """RMS errors in m along the box's y axis, and across it."""
    shift = inverse(found.T_cw)[:, :3, 3] - inverse(np.array(truth))[:, :3, 3]
    return float(np.sqrt(np.mean(shift[:, 1] ** 2))), float(np.sqrt(np.mean(shift[:, [0, 2]] ** 2)))


def numeric(function, size: int, step: float = 1e-6) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Derivative of a vector function at zero."""
    return np.stack([(function(d) - function(-d)) / (2 * step) for d in step * np.eye(size)], axis=1)


@given(seeds)
def test_the_error_of_a_plane_is_in_standard_deviations_and_its_jacobians_are_right(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_cw, plane_w = random_pose(rng), random_plane(rng)
    seen = shifted(plane_w.transformed(T_cw), 1e-2 * rng.standard_normal(3))
    error = PlaneError((0, 1), seen, whitening(seen.covariance))
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
    found = PlaneError((0, 1), local, whitening(local.covariance))(None, values, None)
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
    graph = PoseGraph(SolvingSettings(robust="none"))
    graph.add_first(0, random_pose(rng))
    graph.add_keyframe(1, {0: first})
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
    graph = PoseGraph(SolvingSettings())
    chain(graph, np.eye(4), [step] * 4)
    graph.add_closure(0, 4, RelativePose(se3_exp([0, 0, 0, 0.01, 0, -3.0]), information))
    found = graph.optimise().T_cw[4]
    assert_allclose(found[2, 3], -4.0, atol=1e-3)
    assert_allclose(found[0, 3], 0.01, atol=1e-3)


def test_information_need_not_be_in_the_frame_of_the_earlier_keyframe() -> None:
    """A motion known well along j's x axis only is known along that axis, wherever i looks."""
    T_ji = se3_exp([0.0, 1.2, 0.0, 0.0, 0.0, 0.0])
    sigma = np.array([1e-4, 1e-4, 1e-4, 1e-4, 10.0, 10.0])
    graph = PoseGraph(SolvingSettings())
    chain(graph, np.eye(4), [RelativePose(T_ji, np.diag(sigma**-2.0))])
    graph.optimise()
    assert_allclose(np.sqrt(np.diag(graph.relative(0, 1)[1])), sigma, rtol=0.01)


@pytest.mark.parametrize("solver", ["incremental", "batch"])
def test_solvers_agree(solver: str) -> None:
    truth, motions, views = simulated(ROOM, turning, 20, 0)
    graph = PoseGraph(SolvingSettings(graph_solver=solver, relinearise=1e-4))
    chain(graph, truth[0], motions)
    for k, seen in enumerate(views):
        graph.add_plane_observations([Sighting(k, plane_id, plane) for plane_id, plane in seen.items()])
    found = graph.optimise()
    assert rms_m(found, truth) < 0.02
    reference = run(changed(LANDMARKS, relinearise=1e-4), truth, motions, views)
    assert_allclose(found.T_cw, reference.T_cw, atol=2e-3)
    assert_allclose(found.planes, reference.planes, atol=5e-3)
    for plane_id, plane in zip(found.plane_ids, found.planes, strict=True):
        normal, offset = ROOM.plane(int(plane_id))
        assert_allclose(plane, [*normal, offset], atol=0.02)


@pytest.mark.parametrize("formulation", ["closures", "landmarks", "both"])
def test_planes_seen_again_straighten_a_corridor(formulation: str) -> None:
    """20 m walked once; the same walls are seen all along. Every seed gains, and twofold over all."""
    drift, corrected = [], []
    for seed in range(4):
        truth, motions, views = simulated(CORRIDOR, walking, 60, seed)
        drift.append(rms_m(run(LANDMARKS, truth, motions, [{}] * 60), truth))
        corrected.append(rms_m(run(ClosureConfig(formulation=formulation), truth, motions, views), truth))
    assert np.all(np.array(corrected) < drift)
    assert np.sqrt(np.mean(np.square(corrected))) < 0.5 * np.sqrt(np.mean(np.square(drift)))


@pytest.mark.parametrize("formulation", ["closures", "landmarks", "both"])
@pytest.mark.parametrize("visible", [(0, 2, 3, 5), (0, 1, 2, 3, 4, 5)], ids=["two directions", "three directions"])
def test_a_turning_camera_keeps_what_planes_leave_free(formulation: str, visible: tuple[int, ...]) -> None:
    """Without floor and ceiling the height is free: it follows odometry. What planes fix gets better."""
    fixed, free = [], []
    for seed in range(3):
        truth, motions, views = simulated(ROOM, turning, 40, seed)
        views = [{k: plane for k, plane in seen.items() if k in visible} for seen in views]
        odometry_only = heights_and_ground(run(LANDMARKS, truth, motions, [{}] * 40), truth)
        found = heights_and_ground(run(ClosureConfig(formulation=formulation), truth, motions, views), truth)
        fixed.append((found[1], odometry_only[1]))
        free.append((found[0], odometry_only[0]))
    after, before = np.mean(fixed, axis=0)
    assert after < 0.5 * before
    after, before = np.mean(free, axis=0)
    assert after < (1.2 * before if 1 not in visible else 0.6 * before)


@pytest.mark.parametrize("formulation", ["closures", "landmarks", "both"])
def test_parallel_planes_alone_change_nothing_in_free_directions(formulation: str) -> None:
    """A camera that turns over a floor and under a ceiling, with odometry of the usual certainty and exact."""
    truth, motions, views = simulated(ROOM, turning, 40, 0, noise=0.0)
    rng = np.random.default_rng(1)
    views = [{k: p for k, p in ROOM.views(T, rng).items() if k in (1, 4)} for T in truth]
    assert sum(map(len, views)) > 30
    found = run(ClosureConfig(formulation=formulation), truth, motions, views)
    shift = inverse(found.T_cw)[:, :3, 3] - inverse(np.array(truth))[:, :3, 3]
    assert np.abs(shift[:, [0, 2]]).max() < 1e-3
    heading = [se3_log(inverse(T) @ true)[:3] @ true[:3, :3].T[1] for T, true in zip(found.T_cw, truth, strict=True)]
    assert np.abs(heading).max() < 2e-3  # odometry alone knows it to 20 mrad in the end


@pytest.mark.parametrize("gated", [True, False])
def test_a_tenth_of_closures_wrong(gated: bool) -> None:
    """Moved by some 3 degrees and 20 cm: the result is within 20 % of the clean one, by robust noise alone too."""
    clean, wrong, moved = [], [], 0
    for seed in range(3):
        for box, path in ((CORRIDOR, walking), (ROOM, turning)):
            world = simulated(box, path, 60, seed)
            config = ClosureConfig(formulation="closures")
            clean.append(rms_m(run(config, *world), world[0]))
            corrupt = Corruption(0.1, np.random.default_rng(seed))
            wrong.append(rms_m(run(config, *world, corrupt, gated), world[0]))
            moved += corrupt.count
    assert moved > 15
    assert np.all(np.array(wrong) < 1.2 * np.array(clean))


def test_a_tenth_of_sightings_wrong() -> None:
    """Turned by 3 degrees and shifted by 10 cm: within 20 % of the clean result, over the seeds."""
    ratios = []
    for seed in range(6):
        truth, motions, views = simulated(CORRIDOR if seed % 2 else ROOM, walking if seed % 2 else turning, 60, seed)
        clean = rms_m(run(LANDMARKS, truth, motions, views), truth)
        rng = np.random.default_rng(100 + seed)
        spoilt = [
            {k: shifted(p, rng.normal(size=3) * [0.05, 0.05, 0.1]) if rng.random() < 0.1 else p for k, p in v.items()}
            for v in views
        ]
        ratios.append(rms_m(run(LANDMARKS, truth, motions, spoilt), truth) / clean)
    assert np.mean(ratios) < 1.2


@pytest.mark.parametrize("solver", ["incremental", "batch"])
def test_planes_that_merge_and_end(solver: str) -> None:
    truth, motions, views = simulated(ROOM, turning, 30, 0)
    graph = PoseGraph(SolvingSettings(graph_solver=solver))
    chain(graph, truth[0], motions)
    for k, seen in enumerate(views):
        graph.add_plane_observations([Sighting(k, i + (10 if k > 15 else 0), plane) for i, plane in seen.items()])
    graph.add_plane_observations([Sighting(3, 99, random_plane(np.random.default_rng(0)))])
    graph.optimise()
    replace_planes(graph, views)
    found, reference = graph.optimise(), run(LANDMARKS, truth, motions, views)
    assert found.plane_ids.tolist() == list(range(6))
    assert_allclose(found.T_cw, reference.T_cw, atol=1e-2)
    replace_planes(graph, [{p: plane for p, plane in seen.items() if p != 5} for seen in views])
    assert 5 not in graph.optimise().plane_ids
    replace_planes(graph, [])
    assert len(graph.optimise().planes) == 0


def test_a_merge_changes_its_own_sightings_alone_and_ends_where_a_new_graph_would(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    truth, motions, views = simulated(ROOM, turning, 20, 0)
    config = SolvingSettings(relinearise=1e-6, robust="none")
    merged, fresh = PoseGraph(config), PoseGraph(config)
    for graph in (merged, fresh):
        chain(graph, truth[0], motions)
    for k, seen in enumerate(views):
        merged.add_plane_observations([Sighting(k, 10 if i == 2 and k < 10 else i, p) for i, p in seen.items()])
        fresh.add_plane_observations([Sighting(k, i, plane) for i, plane in seen.items()])
    merged.optimise()
    told: list[Change] = []
    update = Incremental.update
    monkeypatch.setattr(Incremental, "update", lambda solver, change: told.append(change) or update(solver, change))
    merged.replace_plane(10, {})
    merged.replace_plane(2, {k: seen[2] for k, seen in enumerate(views) if 2 in seen})
    found, reference = merged.optimise(), fresh.optimise()
    moved = {k for k, seen in enumerate(views) if 2 in seen and k < 10}
    assert 0 < len(moved) < 10
    assert told[0].gone == {(k, 10) for k in moved}
    assert told[0].factors.keys() == {(k, 2) for k in moved}
    assert found.plane_ids.tolist() == reference.plane_ids.tolist() == sorted({i for seen in views for i in seen})
    assert_allclose(found.T_cw, reference.T_cw, atol=1e-6)
    assert_allclose(found.planes, reference.planes, atol=1e-6)


@pytest.mark.parametrize("solver", ["incremental", "batch"])
def test_a_plane_seen_anew_by_a_keyframe_counts_once(solver: str) -> None:
    """The keyframe is fixed, so the plane is where the latest sighting of it says."""
    graph = PoseGraph(SolvingSettings(graph_solver=solver))
    graph.add_first(0, np.eye(4))
    plane = random_plane(np.random.default_rng(0), sigma=1e-3)
    for error in (np.zeros(3), np.array([0.0, 0.0, 0.002])):
        seen = shifted(plane, error)
        graph.add_plane_observations([Sighting(0, 4, seen)])
        found = graph.optimise()
        assert_allclose(found.planes, [[*seen.normal, seen.offset_m]], atol=1e-6)
    graph.replace_plane(4, {})
    graph.replace_plane(4, {0: plane})
    assert_allclose(graph.optimise().planes, [[*plane.normal, plane.offset_m]], atol=1e-6)


def test_what_cholesky_cannot_solve_qr_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """Planes known to a micrometre beside motions that hardly say anything: a condition of 1e18."""
    truth, motions, views = simulated(ROOM, turning, 12, 0, noise=0.0)
    graph = PoseGraph(SolvingSettings(robust="none"))
    chain(graph, truth[0], [RelativePose(motion.T_ji, np.zeros((6, 6))) for motion in motions])
    careful: list[bool] = []
    monkeypatch.setattr(
        "tgslam.graph.pose_graph.make_solver",
        lambda config, **options: careful.append(options.get("careful", False)) or make_solver(config, **options),
    )
    for k, seen in enumerate(views):
        exact = {i: replace(plane, covariance=1e-6 * plane.covariance) for i, plane in seen.items() if i in (0, 3)}
        graph.add_plane_observations([Sighting(k, i, plane) for i, plane in exact.items()])
    assert_allclose(graph.optimise().T_cw, truth, atol=1e-3)
    assert careful == [True]


def test_the_first_keyframe_stays_and_others_come_back_in_order() -> None:
    rng = np.random.default_rng(0)
    first = random_pose(rng)
    graph = PoseGraph(SolvingSettings())
    graph.add_first(7, first)
    graph.add_keyframe(30, {7: RelativePose(random_pose(rng), 1e4 * np.eye(6))})
    graph.add_keyframe(12, {7: RelativePose(random_pose(rng), 1e4 * np.eye(6))})
    found = graph.optimise()
    assert found.keyframes.tolist() == [7, 12, 30]
    assert_allclose(found.T_cw[0], first, atol=1e-9)
    assert found.planes.shape == (0, 4)


def test_odometry_from_several_keyframes_is_weighed() -> None:
    """Keyframe 2 is placed by the first motion given, and lands where the information of both puts it."""
    graph = PoseGraph(SolvingSettings())
    chain(graph, np.eye(4), [RelativePose(np.eye(4), 1e10 * np.eye(6))])
    shares = {0: 0.25, 1: 0.75}
    steps = {0: se3_exp([0, 0, 0, 0.0, 0, 0]), 1: se3_exp([0, 0, 0, 0.004, 0, 0])}
    graph.add_keyframe(2, {k: RelativePose(steps[k], 1e4 * share * np.eye(6)) for k, share in shares.items()})
    assert_allclose(graph.optimise().T_cw[2][:3, 3], [0.003, 0.0, 0.0], atol=1e-6)
    with pytest.raises(GraphError, match="no odometry"):
        graph.add_keyframe(3, {})


@pytest.mark.parametrize("solver", ["incremental", "batch"])
def test_odometry_that_says_nothing_is_no_singular_system(solver: str) -> None:
    graph = PoseGraph(SolvingSettings(graph_solver=solver))
    step = se3_exp([0, 0, 0, 0, 0, -1.0])
    chain(graph, np.eye(4), [RelativePose(step, np.zeros((6, 6)))] * 3)
    assert_allclose(graph.optimise().T_cw[3], np.linalg.matrix_power(step, 3), atol=1e-6)


def test_what_cannot_be_used_is_refused_with_a_message() -> None:
    motion = RelativePose(np.eye(4), np.eye(6))
    graph = PoseGraph(SolvingSettings())
    with pytest.raises(GraphError, match="no keyframes"):
        graph.estimate()
    with pytest.raises(GraphError, match="keyframe 0"):
        graph.add_keyframe(3, {0: motion})
    graph.add_first(0, np.eye(4))
    with pytest.raises(GraphError, match="keyframe 1"):
        graph.add_first(1, np.eye(4))
    with pytest.raises(GraphError, match="not finite"):
        graph.add_keyframe(1, {0: RelativePose(np.full((4, 4), np.nan), np.eye(6))})
    graph.add_keyframe(1, {0: motion})
    with pytest.raises(GraphError, match="negative"):
        graph.add_closure(0, 1, RelativePose(np.eye(4), -np.eye(6)))
    with pytest.raises(GraphError, match="keyframe 5"):
        graph.add_closure(0, 5, motion)
    with pytest.raises(GraphError, match="covariance"):
        unsound = replace(random_plane(np.random.default_rng(0)), covariance=np.zeros((3, 3)))
        graph.add_plane_observations([Sighting(0, 0, unsound)])
    graph.optimise()
    graph.add_keyframe(2, {1: motion})
    with pytest.raises(GraphError, match="0 and 2"):
        graph.relative(0, 2)
    with pytest.raises(GraphError, match="keyframe 5"):
        graph.relative(0, 5)
    graph.optimise()
    graph.relative(0, 2)


def test_a_singular_system_is_a_graph_error_or_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = PoseGraph(SolvingSettings())
    chain(graph, np.eye(4), [RelativePose(np.eye(4), np.eye(6))])
    graph.optimise()

    def fail(*arguments: object) -> None:
        raise RuntimeError("\nIndeterminant linear system detected near variable x1\n")

    monkeypatch.setattr("tgslam.graph.solvers.Incremental.update", fail)
    with pytest.raises(GraphError, match="Indeterminant linear system"):
        graph.optimise()
    monkeypatch.undo()
    assert len(graph.optimise().keyframes) == 2


def test_an_estimate_that_is_lost_is_a_graph_error() -> None:
    """Infinite certainty about contradictory motions: whatever gtsam makes of it, no traceback of its own."""
    graph = PoseGraph(SolvingSettings(robust="none"))
    chain(graph, np.eye(4), [RelativePose(np.eye(4), 1e300 * np.eye(6))])
    graph.add_closure(0, 1, RelativePose(se3_exp([3.0, 0, 0, 1e6, 0, 0]), 1e300 * np.eye(6)))
    try:
        graph.optimise()
    except GraphError as error:
        assert "no solution" in str(error)


@given(seeds)
def test_widened_motions_have_the_information_of_added_errors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    part = rng.standard_normal((6, 6))
    information = 1e3 * (part @ part.T + 0.1 * np.eye(6))
    expected = np.linalg.inv(np.linalg.inv(information) + np.diag([0.01**2] * 3 + [0.02**2] * 3))
    assert_allclose(
        RelativePose(np.eye(4), information).widened(0.01, 0.02).information,
        expected,
        rtol=1e-6,
        atol=1e-6 * expected.max(),
    )
    information[:, 2] = information[2] = 0.0
    assert_allclose(RelativePose(np.eye(4), information).widened(0.01, 0.02).information[2], 0.0, atol=1e-9)
