"""The refinement of closures on points: kernels against float64, and what it gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.closure_views import CAMERA, NOISE, SIGMA_PER_M2, WALK, fits, motion, view
from tests.reference import closure_icp as reference
from tgslam.config.graph_settings import AcceptanceSettings, IcpSettings
from tgslam.device import runtime
from tgslam.geometry import inverse, se3_exp, se3_log, tangent_axes
from tgslam.graph.relative import measure
from tgslam.graph.structure.candidates import shared_planes
from tgslam.graph.structure.icp import Registration, View
from tgslam.ops import closure_icp as closure_fit

CONFIG = IcpSettings(samples_px=4)
LIMITS = AcceptanceSettings()
MODEL = 0.003


def plane_rows(rng: np.random.Generator, count: int) -> np.ndarray:
    """[count, 12] as the kernel takes them."""
    rows = []
    for _ in range(count):
        normal = rng.standard_normal(3)
        normal /= np.linalg.norm(normal)
        first, second = tangent_axes(normal)
        centroid = rng.uniform(1, 2, 3)
        rows.append([*normal, -normal @ centroid, *first, first @ centroid, *second, second @ centroid])
    return np.array(rows)


@pytest.mark.parametrize(("points", "planes"), [(700, 5), (64, 1), (1, 2)])
def test_heights_of_points(points: int, planes: int) -> None:
    rng = np.random.default_rng(0)
    rows = plane_rows(rng, planes)
    row = rng.integers(-1, planes, points)
    at = rng.uniform(0.5, 3.0, (points, 3))
    near = row >= 0
    at[near] -= 0.97 * (np.sum(at * rows[row, :3], 1) + rows[row, 3])[near, None] * rows[row, :3][near]
    at = np.float32(at)
    expected = reference.plane_heights(at.astype(float), row, rows, SIGMA_PER_M2, MODEL)
    got = closure_fit.height_moments(runtime.to_device(at), runtime.to_device(row, np.int32), rows, NOISE, MODEL)
    w, u, v, uu, uv, vv, h, uh, vh, count = expected.T
    information = np.moveaxis(np.array([[vv, -uv, v], [-uv, uu, -u], [v, -u, w]]), -1, 0)
    assert_allclose(got.information, information, rtol=2e-3, atol=1e-4 * abs(information).max(initial=0.0))
    moment = np.stack([vh, -uh, h], 1)
    assert_allclose(got.moment, moment, rtol=2e-3, atol=2e-4 * abs(moment).max(initial=0.0))
    assert_allclose(got.points, count)


@pytest.mark.parametrize("step", [1, 3])
def test_distances_from_a_surface(step: int) -> None:
    rng = np.random.default_rng(0)
    still, moving = (view(T, rng) for T in WALK)
    v, u = np.mgrid[1 : CAMERA.height : 2 * step, 1 : CAMERA.width : 2 * step].reshape(2, -1)
    z = moving.depth_m[v, u]
    points = np.float32(CAMERA.points_at(u, v, z))
    T_ij = inverse(se3_exp([0.01, 0.02, -0.01, 0.02, 0.01, 0.03]) @ motion())
    expected = reference.surface_distances(
        points.astype(float), T_ij, still.depth_m.astype(float), CAMERA.intrinsics, SIGMA_PER_M2, MODEL, 0.1
    )
    got = closure_fit.surface_distances(
        runtime.to_device(points), T_ij, runtime.to_device(still.depth_m), CAMERA, NOISE, MODEL, 0.1
    )
    assert expected[3] > 100
    assert abs(got.matches - expected[3]) <= max(2, 0.005 * expected[3])  # rounding, at a pixel's border
    assert_allclose(got.A, expected[0], rtol=0.02, atol=5e-3 * abs(expected[0]).max())
    assert_allclose(got.b, expected[1], rtol=0.02, atol=5e-3 * abs(expected[1]).max())
    assert_allclose(got.squares, expected[2], rtol=0.02)


def test_the_derivative_is_by_a_left_perturbation_of_the_motion() -> None:
    still, moving = (view(T, np.random.default_rng(0), noise=0.0) for T in WALK)
    v, u = np.mgrid[1 : CAMERA.height : 5, 1 : CAMERA.width : 5].reshape(2, -1)
    z = moving.depth_m[v, u].astype(float)
    points = CAMERA.points_at(u, v, z)
    depth = still.depth_m.astype(float)
    T_ji, xi = se3_exp([0.01, 0.0, 0.01, 0.01, 0.0, 0.02]) @ motion(), 1e-5 * np.random.default_rng(1).normal(size=6)
    first = {k: (e, j) for k, e, j, *_ in reference.matches(points, inverse(T_ji), depth, CAMERA.intrinsics, 0.1)}
    second = {
        k: e for k, e, *_ in reference.matches(points, inverse(se3_exp(xi) @ T_ji), depth, CAMERA.intrinsics, 0.1)
    }
    change = np.array([(second[k] - e, j @ xi) for k, (e, j) in first.items() if k in second])
    same_pixel = abs(change[:, 0] - change[:, 1]) < 1e-8
    assert same_pixel.mean() > 0.95


def refined(
    views: list[View], planes: list[dict], prior: np.ndarray, config: IcpSettings, ids: tuple[int, ...] | None = None
):  # type: ignore[no-untyped-def]
    """Before and after, from planes `ids` alone (default: all that both see)."""
    chosen = [{k: p for k, p in side.items() if ids is None or k in ids} for side in planes]
    shared, pairs = shared_planes(*chosen)
    start = measure(pairs, prior, LIMITS)
    return start, Registration((views[0], views[1]), shared, CAMERA, NOISE, config, LIMITS).refine(pairs, start)


def error_of(found) -> np.ndarray:  # type: ignore[no-untyped-def]
    return se3_log(found.T_ji @ inverse(motion()))


def test_points_improve_poor_plane_fits() -> None:
    before, after = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        views = [view(T, rng, balls=False) for T in WALK]
        planes = [fits(seen, T, rng) for seen, T in zip(views, WALK, strict=True)]
        prior = se3_exp(0.05 * rng.uniform(-1, 1, 6)) @ motion()
        start, found = refined(views, planes, prior, CONFIG)
        assert found.rank == start.rank >= 5
        before.append(start.directions @ error_of(start))
        after.append(start.directions @ error_of(found))
    assert np.sqrt(np.mean(np.square(after))) < 0.4 * np.sqrt(np.mean(np.square(before)))


def test_points_do_not_spoil_good_plane_fits() -> None:
    """Fits to all pixels of a view are that good: those of the ICP, to some of them, must not be worse."""
    before, after = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        views = [view(T, rng, balls=False) for T in WALK]
        planes = [fits(seen, T, rng, noise=0.15) for seen, T in zip(views, WALK, strict=True)]
        start, found = refined(views, planes, motion(), IcpSettings())
        before.append(start.directions @ error_of(start))
        after.append(start.directions @ error_of(found))
    assert np.sqrt(np.mean(np.square(after))) < 0.6 * np.sqrt(np.mean(np.square(before)))


def test_pixels_of_something_else_are_left_out() -> None:
    rng = np.random.default_rng(0)
    views = [view(T, rng, balls=False) for T in WALK]
    planes = [fits(seen, T, rng, noise=0.3) for seen, T in zip(views, WALK, strict=True)]
    depth = views[1].depth_m.copy()
    depth[30:60, 60:90] *= 0.9  # 20 cm in front of the wall, and labelled as wall
    wrong = [views[0], replace(views[1], depth_m=depth)]
    clean = refined(views, planes, motion(), CONFIG)[1]
    found = refined(wrong, planes, motion(), CONFIG)[1]
    assert np.linalg.norm(error_of(found)) < np.linalg.norm(error_of(clean)) + 2e-3


def test_points_off_planes_fill_the_line_that_two_planes_share() -> None:
    rng = np.random.default_rng(0)
    views = [view(T, rng) for T in WALK]
    planes = [fits(seen, T, rng, noise=0.3) for seen, T in zip(views, WALK, strict=True)]
    prior = se3_exp([0, 0, 0, 0.04, 0, 0]) @ motion()  # along the line of floor and end wall
    start, found = refined(views, planes, prior, CONFIG, ids=(4, 5))
    assert start.rank == 5 and found.rank == 6
    assert np.linalg.norm(error_of(start)[3:]) > 0.03
    assert np.linalg.norm(error_of(found)[3:]) < 0.008


def test_without_such_points_it_stays_at_the_prior() -> None:
    rng = np.random.default_rng(0)
    views = [view(T, rng, balls=False) for T in WALK]
    planes = [fits(seen, T, rng, noise=0.0) for seen, T in zip(views, WALK, strict=True)]
    prior = se3_exp([0, 0, 0, 0.04, 0, 0]) @ motion()
    _, found = refined(views, planes, prior, CONFIG, ids=(4, 5))
    assert found.rank == 5
    line = inverse(WALK[0])[:3, :3].T @ np.array([1.0, 0, 0])
    shift = inverse(found.T_ji)[:3, 3] - inverse(prior)[:3, 3]
    assert abs(shift @ line) < 1e-3


def test_many_points_do_not_make_an_edge_certain() -> None:
    rng = np.random.default_rng(0)
    views = [view(T, rng) for T in WALK]
    planes = [fits(seen, T, rng) for seen, T in zip(views, WALK, strict=True)]
    coarse, fine = (
        refined(views, planes, motion(), IcpSettings(samples_px=step))[1].motion.information for step in (6, 1)
    )
    assert_allclose(np.trace(fine[3:, 3:]), np.trace(coarse[3:, 3:]), rtol=0.1)
