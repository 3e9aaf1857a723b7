"""The depth camera: projection and rays are each other's inverse, for smaller images too; its noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from tgslam.camera import Camera, SensorNoise

CAMERA = Camera(64, 48, 60.0, 62.0, 31.5, 22.25)
lengths_px = st.floats(-50.0, 700.0)
depths_m = st.floats(0.01, 100.0)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    width, height = draw(st.integers(8, 640)), draw(st.integers(8, 640))
    fx, fy = (draw(st.floats(20.0, 1000.0)) for _ in range(2))
    return Camera(width, height, fx, fy, draw(st.floats(0.0, width - 1.0)), draw(st.floats(0.0, height - 1.0)))


@given(cameras(), lengths_px, lengths_px, depths_m)
def test_what_is_seen_at_a_place_appears_there(camera: Camera, u: float, v: float, depth_m: float) -> None:
    point = camera.points_at(u, v, depth_m)
    assert point.shape == (3,)
    assert point[2] == depth_m
    assert_allclose(camera.project(point), (u, v), rtol=1e-9, atol=1e-7)


@given(cameras(), st.integers(0, 2**32 - 1))
def test_a_point_is_seen_where_it_appears(camera: Camera, seed: int) -> None:
    points = np.random.default_rng(seed).uniform([-2.0, -2.0, 0.5], [2.0, 2.0, 4.5], (3, 4, 3))
    u, v = camera.project(points)
    assert u.shape == v.shape == (3, 4)
    assert_allclose(camera.points_at(u, v, points[..., 2]), points, rtol=1e-9, atol=1e-9)


def test_projection_is_opencvs() -> None:
    points = np.random.default_rng(0).uniform([-1.0, -1.0, 1.0], [1.0, 1.0, 3.0], (20, 3))
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA.matrix, None)[0][:, 0]
    assert_allclose(np.stack(CAMERA.project(points), -1), expected, atol=1e-9)
    assert_array_equal(CAMERA.matrix, [[60.0, 0.0, 31.5], [0.0, 62.0, 22.25], [0.0, 0.0, 1.0]])
    assert_array_equal(CAMERA.intrinsics, [60.0, 62.0, 31.5, 22.25])


def test_what_is_at_the_camera_or_behind_it_appears_as_if_it_were_1_mm_away() -> None:
    u, v = CAMERA.project(np.array([[0.0, 0.0, 0.0], [1e-3, 0.0, -5.0], [0.0, 1e-3, 1e-4]]))
    assert_allclose(u, [31.5, 91.5, 31.5])
    assert_allclose(v, [22.25, 22.25, 84.25])


def test_rays_are_those_of_the_pixels() -> None:
    rays = CAMERA.rays()
    assert rays.shape == (*CAMERA.shape, 3) == (48, 64, 3)
    assert_array_equal(rays[5, 7], CAMERA.rays_at(7, 5))
    assert_array_equal(rays[5, 7], [(7 - 31.5) / 60.0, (5 - 22.25) / 62.0, 1.0])
    u, v = CAMERA.project(2.0 * rays)
    assert_allclose(u, np.broadcast_to(np.arange(64), CAMERA.shape), atol=1e-9)
    assert_allclose(v, np.broadcast_to(np.arange(48)[:, None], CAMERA.shape), atol=1e-9)


@given(cameras(), st.integers(1, 8))
def test_a_strided_camera_sees_the_rays_of_the_pixels_that_are_left(camera: Camera, step: int) -> None:
    smaller = camera.strided(step)
    expected = camera.rays()[step // 2 :: step, step // 2 :: step]
    assert smaller.rays().shape == expected.shape
    assert_allclose(smaller.rays(), expected, rtol=1e-12, atol=1e-12)


@given(cameras(), st.integers(0, 3))
def test_a_halved_camera_sees_the_mean_rays_of_its_blocks(camera: Camera, times: int) -> None:
    smaller, block = camera.halved(times), 2**times
    assert smaller.shape == (camera.height // block, camera.width // block)
    rays = camera.rays()[: smaller.height * block, : smaller.width * block]
    means = rays.reshape(smaller.height, block, smaller.width, block, 3).mean(axis=(1, 3))
    assert_allclose(smaller.rays(), means, rtol=1e-9, atol=1e-9)


def test_steps_of_one_and_no_halving_change_nothing() -> None:
    assert CAMERA.strided(1) == CAMERA.halved(0) == CAMERA


@pytest.mark.parametrize(("u", "expected"), [(-1.0, False), (0.0, True), (63.0, True), (64.0, False)])
def test_the_image_ends_at_its_last_column(u: float, expected: bool) -> None:
    assert_array_equal(CAMERA.holds(np.array([u, u]), np.array([0.0, 47.0])), [expected, expected])


@pytest.mark.parametrize(("v", "expected"), [(-1.0, False), (0.0, True), (47.0, True), (48.0, False)])
def test_the_image_ends_at_its_last_row(v: float, expected: bool) -> None:
    assert_array_equal(CAMERA.holds(np.array([0.0, 63.0]), np.array([v, v])), [expected, expected])


@given(cameras())
def test_every_pixel_is_held(camera: Camera) -> None:
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    assert camera.holds(u, v).all()
    assert not replace(camera, width=camera.width - 1).holds(u, v)[:, -1].any()


@given(st.floats(1e-5, 0.1), depths_m)
def test_noise_is_the_same_everywhere_in_inverse_depth(per_m2: float, depth_m: float) -> None:
    sigma_m = SensorNoise(per_m2).sigma_m(np.array([depth_m]))
    assert_allclose(sigma_m / depth_m**2, per_m2, rtol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_noise_keeps_the_images_dtype(dtype: type) -> None:
    sigma_m = SensorNoise(0.0015).sigma_m(np.array([[0.0, 1.0, 2.0]], dtype))
    assert sigma_m.dtype == dtype and sigma_m.shape == (1, 3)
    assert_allclose(sigma_m, [[0.0, 0.0015, 0.006]], rtol=1e-6)
