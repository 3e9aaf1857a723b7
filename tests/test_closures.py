"""Structure closures from planes alone: the relative solve, candidates, gating."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from tests.closure_views import CAMERA, NOISE, WALK, fits, motion, view
from tests.plane_worlds import Box, looking, shifted
from tests.test_plane_estimate import random_pose
from tests.tiers import changed
from tgslam.config.graph_settings import AcceptanceSettings, ClosureConfig
from tgslam.geometry import inverse, se3_exp, se3_log, tangent_axes
from tgslam.graph.findings import Findings
from tgslam.graph.gating import passes
from tgslam.graph.relative import PlanePairs, measure, of_planes
from tgslam.graph.structure.candidates import candidates
from tgslam.graph.structure.search import ClosureSearch
from tgslam.planes.estimate import PlaneEstimate, stacked

seeds = st.integers(0, 2**32 - 1)
CONFIG = ClosureConfig()
LIMITS = AcceptanceSettings()
FINE = AcceptanceSettings(known_rad=10.0, known_m=10.0)  # whatever is measured at all counts


def oriented(normals: np.ndarray, rng: np.random.Generator) -> PlaneEstimate:
    """Planes [N] with those normals, some 2 m away, known to 4 mrad and 3 mm."""
    centroid = rng.uniform(-1, 1, (len(normals), 3)) - 2.0 * normals
    covariance = np.tile(np.diag([4e-3, 4e-3, 3e-3]) ** 2, (len(normals), 1, 1))
    return PlaneEstimate(normals, -np.sum(normals * centroid, 1), centroid, tangent_axes(normals), covariance)


def directions(count: int, rng: np.random.Generator) -> np.ndarray:
    """[count, 3] at right angles to each other, up to a few tenths of a radian."""
    normals = np.linalg.qr(rng.standard_normal((3, 3)))[0][:count] + 0.1 * rng.standard_normal((count, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def noisy(planes: PlaneEstimate, rng: np.random.Generator, noise: float = 1.0) -> PlaneEstimate:
    """With errors drawn from their covariances."""
    rows = range(len(planes.normal))
    roots = np.linalg.cholesky(planes.covariance)
    return stacked([shifted(planes[k], noise * roots[k] @ rng.standard_normal(3)) for k in rows])


def small_motion(rng: np.random.Generator, size: float = 0.1) -> np.ndarray:
    return se3_exp(size * rng.uniform(-1, 1, 6))


@given(seeds)
def test_the_derivative_is_that_of_the_residuals(seed: int) -> None:
    rng = np.random.default_rng(seed)
    in_i = oriented(directions(3, rng), rng)
    T_ji = random_pose(rng)
    pairs = PlanePairs(in_i, in_i.transformed(T_ji))
    xi = 1e-4 * rng.standard_normal(6)
    quadratic = of_planes(pairs, T_ji)
    moved = of_planes(pairs, se3_exp(xi) @ T_ji)
    assert quadratic.value < 1e-12
    assert_allclose(moved.value, xi @ quadratic.A @ xi, rtol=2e-3)
    assert_allclose(moved.b, quadratic.A @ xi, atol=2e-3 * abs(quadratic.A @ xi).max())


@given(seeds)
def test_three_planes_give_the_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    in_i, T_ji = oriented(directions(3, rng), rng), random_pose(rng)
    pairs = PlanePairs(in_i, in_i.transformed(T_ji))
    found = measure(pairs, small_motion(rng, 0.3) @ T_ji, FINE)
    assert found.rank == 6
    assert_allclose(found.T_ji, T_ji, atol=1e-6)
    assert found.chi_square < 1e-6 and found.freedom == 3


@given(seeds)
def test_two_planes_leave_their_common_line_to_the_prior(seed: int) -> None:
    rng = np.random.default_rng(seed)
    in_i, T_ji = oriented(directions(2, rng), rng), random_pose(rng)
    pairs = PlanePairs(noisy(in_i, rng), noisy(in_i.transformed(T_ji), rng))
    prior = small_motion(rng) @ T_ji
    found = measure(pairs, prior, LIMITS)
    assert found.rank == 5
    moved = pairs.in_i.transformed(found.T_ji).normal
    line = np.concatenate([np.zeros(3), np.cross(*moved)])
    line /= np.linalg.norm(line)
    information = found.motion.information
    assert_allclose(information @ line, 0.0, atol=1e-9 * abs(information).max())
    # The camera's place along the line is what it was: steps turn about the camera and shift it across the line
    shift = inverse(found.T_ji)[:3, 3] - inverse(prior)[:3, 3]
    assert abs(shift @ np.cross(*pairs.in_i.normal)) < 1e-9
    error = se3_log(found.T_ji @ inverse(T_ji))
    sigma = np.sqrt(found.variance)
    assert np.all(abs(found.directions @ error) < 6 * sigma)


@given(seeds)
def test_parallel_planes_change_nothing_across_their_normal(seed: int) -> None:
    rng = np.random.default_rng(seed)
    normal = directions(1, rng)
    in_i = oriented(np.concatenate([normal, -normal]), rng)
    T_ji = random_pose(rng)
    pairs = PlanePairs(noisy(in_i, rng), noisy(in_i.transformed(T_ji), rng))
    prior = small_motion(rng, 0.02) @ T_ji
    found = measure(pairs, prior, LIMITS)
    assert found.rank == 3
    shift = inverse(found.T_ji)[:3, 3] - inverse(prior)[:3, 3]
    across = shift - (shift @ normal[0]) * normal[0]
    assert np.linalg.norm(across) < 1e-3
    turn = se3_log(found.T_ji @ inverse(prior))[:3]
    assert abs(turn @ (prior[:3, :3] @ normal[0])) < 1e-3


def test_errors_are_as_large_as_said() -> None:
    """Mahalanobis distances of 400 solutions are chi-square distributed."""
    rng = np.random.default_rng(0)
    squares, rest = [], []
    for _ in range(400):
        in_i, T_ji = oriented(directions(3, rng), rng), random_pose(rng)
        found = measure(PlanePairs(noisy(in_i, rng), noisy(in_i.transformed(T_ji), rng)), T_ji, FINE)
        error = se3_log(found.T_ji @ inverse(T_ji))
        squares.append(error @ found.motion.information @ error)
        rest.append(found.chi_square)
    assert_allclose(np.mean(squares), 6.0, rtol=0.12)
    assert_allclose(np.mean(rest), 3.0, rtol=0.15)


def test_a_wrong_match_is_inconsistent() -> None:
    rng = np.random.default_rng(0)
    in_i, T_ji = oriented(directions(3, rng), rng), random_pose(rng)
    in_i = stacked([*(in_i[k] for k in range(3)), oriented(directions(1, rng), rng)[0]])
    in_j = noisy(in_i.transformed(T_ji), rng)
    assert measure(PlanePairs(in_i, in_j), T_ji, LIMITS).consistent(0.999)
    wrong = stacked([*(in_j[k] for k in range(3)), shifted(in_j[3], np.array([0.0, 0.0, 0.1]))])
    assert not measure(PlanePairs(in_i, wrong), T_ji, LIMITS).consistent(0.999)


def test_gating_looks_at_measured_directions_only() -> None:
    rng = np.random.default_rng(0)
    in_i, T_ji = oriented(directions(2, rng), rng), random_pose(rng)
    found = measure(PlanePairs(in_i, in_i.transformed(T_ji)), T_ji, LIMITS)
    line = np.cross(*in_i.transformed(T_ji).normal)
    covariance = 1e-6 * np.eye(6)
    along = se3_exp(np.concatenate([np.zeros(3), 0.5 * line])) @ T_ji
    across = se3_exp(np.concatenate([np.zeros(3), 0.1 * in_i.transformed(T_ji).normal[0]])) @ T_ji
    assert passes(found, along, covariance, 0.99)
    assert not passes(found, across, covariance, 0.99)
    assert passes(found, across, 0.1 * np.eye(6), 0.99)


class TestCandidates:
    ROOM = Box((4.0, 2.5, 5.0))

    def world(self, count: int = 60) -> tuple[list[np.ndarray], list[dict[int, PlaneEstimate]]]:
        rng = np.random.default_rng(0)
        truth = [looking(np.array([2.0, 1.2, 2.5]), 0.4 * np.sin(0.2 * k), 0.3) for k in range(count)]
        return truth, [self.ROOM.views(T, rng) for T in truth]

    def test_bounded_spread_and_not_adjacent(self) -> None:
        truth, views = self.world()
        T_ji = {k: truth[-1] @ inverse(T) for k, T in enumerate(truth[:-1])}
        found = candidates(views[-1], dict(enumerate(views[:-1])), T_ji, CONFIG)
        assert len(found) == CONFIG.expert.edges.max_edges
        ages = [59 - c.keyframe for c in found]
        assert ages == sorted(ages, reverse=True) and ages[0] > 40 and CONFIG.closure_gap < ages[-1] < 20
        assert all(len(c.shared) >= 2 for c in found)

    def test_parallel_or_single_planes_are_no_candidates(self) -> None:
        truth, views = self.world(12)
        parallel = [{k: v for k, v in view.items() if k in (1, 4)} for view in views]
        T_ji = {k: truth[-1] @ inverse(T) for k, T in enumerate(truth[:-1])}
        assert candidates(parallel[-1], dict(enumerate(parallel[:-1])), T_ji, CONFIG) == []

    def test_more_directions_are_better(self) -> None:
        rng = np.random.default_rng(0)
        planes = oriented(directions(3, rng), rng)
        all_three = {k: planes[k] for k in range(3)}
        two = {k: planes[k] for k in range(2)}
        earlier = {0: two, 1: all_three, 2: two, 3: two}
        config = changed(ClosureConfig(), max_edges=1, closure_gap=1)
        (best,) = candidates(all_three, earlier, dict.fromkeys(earlier, np.eye(4)), config)
        assert best.keyframe == 1 and best.shared == (0, 1, 2)


class TestSearch:
    """From sightings to closures, through ICP and gates, in a room with things that are on no plane."""

    CONFIG = changed(ClosureConfig(), interval=2, closure_gap=1, samples_px=4)

    def found(
        self, config: ClosureConfig, graph_T_ji: np.ndarray, sigma: float, planes_of_j: dict | None = None
    ) -> Findings:
        rng = np.random.default_rng(0)
        views = [view(T, rng) for T in WALK]
        first, second = (fits(seen, T, rng, 0.3) for seen, T in zip(views, WALK, strict=True))
        sightings = {0: first, 5: {}, 9: planes_of_j if planes_of_j is not None else second}
        T_cw = {0: np.eye(4), 5: np.eye(4), 9: graph_T_ji}
        search = ClosureSearch(CAMERA, NOISE, config)
        return search.find(
            sightings, T_cw, lambda i, j: (graph_T_ji, sigma**2 * np.eye(6)), lambda k: views[0 if k == 0 else 1]
        )

    def test_finds_the_motion(self) -> None:
        prior = se3_exp([0.01, -0.02, 0.01, 0.03, 0.02, -0.02]) @ motion()
        (closure,) = self.found(self.CONFIG, prior, 0.05).closures
        assert closure.earlier == 0 and len(closure.shared) >= 2
        error = se3_log(closure.measured.T_ji @ inverse(motion()))
        assert np.linalg.norm(closure.measured.directions @ error) < 0.3

    def test_only_every_k_th_keyframe(self) -> None:
        config = replace(self.CONFIG, interval=3)
        assert self.found(config, motion(), 0.05).closures == ()

    def test_disagreement_with_the_graph_is_gated(self) -> None:
        prior = se3_exp([0.05, 0.0, 0.0, 0.0, 0.05, 0.0]) @ motion()
        findings = self.found(self.CONFIG, prior, 1e-3)
        assert findings.closures == () and findings.gated == 1

    def test_planes_that_disagree_are_inconsistent(self) -> None:
        seen = fits(view(WALK[1], np.random.default_rng(0)), WALK[1], np.random.default_rng(0), 0.0)
        wrong = {k: shifted(plane, np.array([0.1 * k, 0.1, 0.1])) for k, plane in seen.items()}
        findings = self.found(self.CONFIG, motion(), 0.05, wrong)
        assert findings.closures == () and findings.inconsistent == 1
