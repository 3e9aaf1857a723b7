"""Planes with covariances: transforms, deviations, fusion."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from tests.plane_views import segment_of
from tests.plane_worlds import shifted
from tgslam.geometry import inverse, se3_exp, tangent_axes
from tgslam.planes.estimate import PlaneEstimate, deviation_sigmas, from_segments, fuse, stacked

seeds = st.integers(0, 2**32 - 1)


def random_plane(rng: np.random.Generator, sigma: float = 0.01) -> PlaneEstimate:
    normal = rng.standard_normal(3)
    normal /= np.linalg.norm(normal)
    centroid = rng.uniform(-3, 3, 3)
    half = sigma * rng.standard_normal((3, 3))
    return PlaneEstimate(
        normal,
        np.asarray(-normal @ centroid),
        centroid,
        tangent_axes(normal),
        half @ half.T + 1e-3 * sigma**2 * np.eye(3),
    )


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return se3_exp(rng.uniform(-2, 2, 6))


@given(seeds)
def test_a_transform_and_back_is_the_same_plane(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plane, T_cw = random_plane(rng), random_pose(rng)
    local = plane.transformed(T_cw)
    assert_allclose(local.normal, T_cw[:3, :3] @ plane.normal)
    assert_allclose(local.offset_m, plane.offset_m - local.normal @ T_cw[:3, 3])
    assert_allclose(local.heights_m(local.centroid), 0.0, atol=1e-9)
    back = local.transformed(inverse(T_cw))
    for ours, theirs in zip(vars(back).values(), vars(plane).values(), strict=True):
        assert_allclose(ours, theirs, atol=1e-9)


@given(seeds)
def test_deviation_does_not_depend_on_the_frame(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plane = random_plane(rng)
    other = shifted(random_plane(rng), np.zeros(3)) if seed % 2 else shifted(plane, 0.02 * rng.standard_normal(3))
    moved = random_pose(rng)
    assert_allclose(
        deviation_sigmas(plane.transformed(moved), other.transformed(moved)),
        deviation_sigmas(plane, other),
        rtol=1e-6,
    )


def test_deviation_is_in_standard_deviations() -> None:
    rng = np.random.default_rng(1)
    truth = random_plane(rng, sigma=0.003)
    root = np.linalg.cholesky(truth.covariance)
    drawn = stacked([shifted(truth, root @ rng.standard_normal(3)) for _ in range(4000)])
    drawn = PlaneEstimate(
        drawn.normal, drawn.offset_m, drawn.centroid, np.broadcast_to(truth.axes, (4000, 2, 3)), drawn.covariance
    )
    exact = PlaneEstimate(truth.normal, truth.offset_m, truth.centroid, truth.axes, np.zeros((3, 3)))
    assert_allclose(np.mean(deviation_sigmas(drawn, exact) ** 2), 3.0, rtol=0.1)


def test_a_segment_far_from_the_others_centroid_may_deviate_farther() -> None:
    covariance = np.diag([0.01, 0.01, 0.001]) ** 2
    axes = tangent_axes(np.array([0.0, 0.0, 1.0]))
    reference = PlaneEstimate(np.array([0.0, 0.0, 1.0]), np.asarray(0.0), np.zeros(3), axes, covariance)
    near = PlaneEstimate(reference.normal, np.asarray(-0.02), np.array([0.0, 0.0, 0.02]), axes, covariance)
    far = PlaneEstimate(reference.normal, np.asarray(-0.02), np.array([4.0, 0.0, 0.02]), axes, covariance)
    assert deviation_sigmas(near, reference) > 10
    assert deviation_sigmas(far, reference) < 1


@given(seeds)
def test_fusing_equal_planes_gives_them_back_with_less_uncertainty(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plane = random_plane(rng)
    fused = fuse(stacked([plane] * 4))
    assert_allclose(fused.normal, plane.normal, atol=1e-9)
    assert_allclose(fused.offset_m, plane.offset_m, atol=1e-9)
    assert_allclose(fused.covariance, plane.covariance / 4, rtol=1e-6, atol=1e-15)
    assert_allclose(fuse(stacked([plane] * 4), independent=2).covariance, plane.covariance / 2, rtol=1e-6, atol=1e-15)


def test_fusion_is_consistent_and_beats_its_parts() -> None:
    rng = np.random.default_rng(3)
    plane = np.array([0.0, 0.0, -1.0, 3.0])
    sigmas, single, together = [], [], []
    for _ in range(100):
        parts = []
        for corner in range(4):
            x, y = rng.uniform(0, 1, (2, 200)) + np.array([[corner % 2], [corner // 2]])
            points = np.column_stack([x, y, np.full(200, 3.0)])
            parts.append(segment_of(points, plane, np.full(200, 1e-3), rng))
        estimates = from_segments(parts)
        fused = fuse(estimates)
        exact = PlaneEstimate(
            plane[:3], np.asarray(3.0), np.array([0, 0, 3.0]), tangent_axes(plane[:3]), np.zeros((3, 3))
        )
        sigmas.append(deviation_sigmas(fused, exact) ** 2)
        single.append(np.arccos(min(1.0, estimates.normal[0] @ plane[:3])))
        together.append(np.arccos(min(1.0, fused.normal @ plane[:3])))
    assert 2.0 < np.mean(sigmas) < 4.5
    assert np.mean(together) < 0.4 * np.mean(single)


def test_one_wrong_view_hardly_moves_the_fused_plane() -> None:
    rng = np.random.default_rng(4)
    plane = random_plane(rng, sigma=0.005)
    wrong = shifted(plane, np.array([0.0, 0.0, 0.2]))
    fused = fuse(stacked([plane] * 6 + [wrong]))
    assert abs(fused.heights_m(plane.centroid)) < 0.01


def test_a_pose_error_spreads_as_random_poses_do() -> None:
    rng = np.random.default_rng(5)
    plane = random_plane(rng)
    exact = PlaneEstimate(plane.normal, plane.offset_m, plane.centroid, plane.axes, np.zeros((3, 3)))
    claimed = exact.with_pose_error(0.004, 0.01)
    poses = [se3_exp(rng.standard_normal(6) * np.repeat([0.004, 0.01], 3)) for _ in range(4000)]
    moved = exact.transformed(np.stack(poses))
    heights = -(moved.normal @ plane.centroid + moved.offset_m) / (moved.normal @ plane.normal)
    tangential = moved.normal @ plane.axes.T
    errors = np.column_stack([-tangential[:, 1], tangential[:, 0], heights])
    assert_allclose(np.cov(errors.T), claimed.covariance, rtol=0.15, atol=2e-6)


@given(seeds)
def test_axes_are_those_of_segments(seed: int) -> None:
    normal = random_plane(np.random.default_rng(seed)).normal
    assert_allclose(tangent_axes(normal), tangent_axes(normal))
