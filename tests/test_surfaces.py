"""Distances to the scenes' surfaces against dense samples of them, and areas of their faces."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from tests.test_synthetic import points_c, source
from tgslam.geometry import transform_points
from tgslam.kernels import procedural
from tgslam.synthetic.primitives import surface_distance_m
from tgslam.synthetic.scene import Material, Scene, SceneBuilder

GREY = Material(procedural.PLAIN, (0.5, 0.5, 0.5))
STEP_M = 0.004  # of the samples


def grid(*counts: int) -> list[np.ndarray]:
    return [axis.ravel() for axis in np.meshgrid(*(np.linspace(-1, 1, count) for count in counts), indexing="ij")]


def rectangle(axis: int, offset: float, half: np.ndarray) -> np.ndarray:
    """Points on the rectangle of half sizes `half` [3] at `offset` along an axis."""
    points = np.zeros((10_000, 3))
    for k, values in zip([k for k in range(3) if k != axis], grid(100, 100), strict=True):
        points[:, k] = half[k] * values
    points[:, axis] = offset
    return points


def sphere() -> np.ndarray:
    u, v = grid(400, 400)
    return np.column_stack([np.sqrt(1 - v**2) * np.cos(np.pi * u), np.sqrt(1 - v**2) * np.sin(np.pi * u), v])


def box_samples(half: np.ndarray) -> np.ndarray:
    return np.concatenate([rectangle(k, sign * half[k], half) for k in range(3) for sign in (-1, 1)])


def cylinder_samples(radius: float, half_height: float) -> np.ndarray:
    u, v = grid(400, 150)
    side = np.column_stack([radius * np.cos(np.pi * u), radius * np.sin(np.pi * u), half_height * v])
    reach = radius * (v + 1) / 2
    cap = np.column_stack([reach * np.cos(np.pi * u), reach * np.sin(np.pi * u), np.full_like(u, half_height)])
    return np.concatenate([side, cap, cap * [1, 1, -1]])


def assert_distances(scene: Scene, samples_w: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.uniform(-0.6, 0.6, (400, 3)), samples_w[:: len(samples_w) // 50]])
    expected = cKDTree(samples_w).query(points)[0]
    found = surface_distance_m(scene, points)
    assert (found <= expected + 1e-9).all()  # samples lie on the surface
    assert (np.sqrt(found**2 + (2 * STEP_M) ** 2) >= expected - STEP_M).all()


def test_a_quad_a_box_a_cylinder_and_an_ellipsoid() -> None:
    yaw = 0.7
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    for seed, (add, samples) in enumerate(
        (
            (
                lambda b: b.quad((0.1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, 0.4), GREY),
                rectangle(0, 0.1, np.array([0, 0.3, 0.2])),
            ),
            (
                lambda b: b.box((0, 0.1, 0), (0.5, 0.4, 0.3), GREY, yaw),
                box_samples(np.array([0.25, 0.2, 0.15])) @ turn.T + [0, 0.1, 0],
            ),
            (lambda b: b.cylinder((0, 0, -0.2), 0.25, 0.4, GREY), cylinder_samples(0.25, 0.2)),
            (
                lambda b: b.ellipsoid((0, 0, 0.1), (0.3, 0.1, 0.2), GREY, yaw),
                (sphere() * [0.3, 0.1, 0.2]) @ turn.T + [0, 0, 0.1],
            ),
        )
    ):
        builder = SceneBuilder()
        add(builder)
        assert_distances(builder.build(occlusion=False), samples, seed)


def test_the_nearest_of_several_counts_and_pictures_do_not() -> None:
    builder = SceneBuilder()
    wall = builder.quad((0.5, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1), GREY)
    builder.quad((0.5, 2.0, 0), (0, 1, 0), (0, 0, 1), (0.2, 0.2), GREY, painted_on=wall)
    builder.box((-0.5, 0, 0), (0.2, 0.2, 0.2), GREY)
    points = np.array([[0.0, 0, 0], [0.4, 0, 0], [-0.5, 0.05, 0], [0.5, 2.0, 0]])
    np.testing.assert_allclose(surface_distance_m(builder.build(False), points), [0.4, 0.1, 0.05, 1.5], atol=1e-12)


@given(
    st.lists(st.floats(0.02, 0.5), min_size=3, max_size=3),
    st.lists(st.floats(-0.8, 0.8), min_size=3, max_size=3),
)
def test_the_distance_to_a_sphere_and_the_foot_on_any_ellipsoid(radii: list[float], point: list[float]) -> None:
    p = np.array([point])
    builder = SceneBuilder()
    builder.ellipsoid((0, 0, 0), [radii[0]] * 3, GREY)
    found = surface_distance_m(builder.build(False), p)
    np.testing.assert_allclose(found, np.abs(np.linalg.norm(p, axis=1) - radii[0]), atol=1e-7)
    other = SceneBuilder()
    other.ellipsoid((0, 0, 0), radii, GREY)
    found = surface_distance_m(other.build(False), p)
    level = np.linalg.norm(p / radii)
    assert found[0] <= min(abs(abs(point[k]) - radii[k]) + np.linalg.norm(np.delete(p[0], k)) for k in range(3)) + 1e-9
    assert (found[0] > 1e-7) or abs(level - 1) < 1e-4  # only points on the surface have no distance to it


@pytest.mark.parametrize("scene", ["room", "desk", "corridor"])
def test_what_the_camera_sees_is_at_the_surface(scene: str) -> None:
    one = source(scene)
    truth = one.truth()
    for index in (0, 200):
        depth_m = one.clean(index).depth_m
        points_w = transform_points(one.pose(index), points_c(one.camera, depth_m))[depth_m > 0]
        assert truth.surface_distance_m(points_w).max() < 1e-4
        towards = one.pose(index)[:3, 3] - points_w
        lifted = points_w + 0.02 * towards / np.linalg.norm(towards, axis=1, keepdims=True)
        assert (truth.surface_distance_m(lifted) <= 0.02 + 1e-4).all()
