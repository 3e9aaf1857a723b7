"""Properties of rigid motions and of the camera, on random and on extreme values."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from tgslam import geometry
from tgslam.camera import Camera

MAGNITUDES = st.one_of(
    st.floats(0.0, math.pi - 1e-4),
    st.sampled_from([0.0, 1e-300, 1e-12, 1e-9, 1.01e-8, 1e-7, 1e-5, 1.01e-5, 1e-4, 1e-3, math.pi - 1e-6]),
)


@st.composite
def unit_vectors(draw: st.DrawFn) -> np.ndarray:
    vector = np.array(draw(st.lists(st.floats(-1, 1), min_size=3, max_size=3)))
    assume(np.linalg.norm(vector) > 1e-2)
    return vector / np.linalg.norm(vector)


@st.composite
def twists(draw: st.DrawFn) -> np.ndarray:
    translation = draw(st.lists(st.floats(-10, 10), min_size=3, max_size=3))
    return np.concatenate([draw(unit_vectors()) * draw(MAGNITUDES), translation])


def transform(xi: np.ndarray) -> np.ndarray:
    T = np.zeros((4, 4))
    T[:3, :3], T[:3, 3] = geometry.hat(xi[:3]), xi[3:]
    return expm(T)


@given(twists())
def test_exp_is_the_matrix_exponential(xi: np.ndarray) -> None:
    np.testing.assert_allclose(geometry.se3_exp(xi), transform(xi), atol=1e-10)


@given(twists())
def test_log_undoes_exp(xi: np.ndarray) -> None:
    np.testing.assert_allclose(geometry.se3_log(geometry.se3_exp(xi)), xi, atol=1e-8)


@given(twists())
def test_small_rotations_keep_their_digits(xi: np.ndarray) -> None:
    omega = xi[:3] * 1e-6
    np.testing.assert_allclose(geometry.so3_log(geometry.so3_exp(omega)), omega, rtol=1e-7, atol=1e-16)


@given(unit_vectors(), st.sampled_from([0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-3]), st.sampled_from([-1.0, 1.0]))
def test_rotations_by_pi_keep_their_axis_up_to_sign(axis: np.ndarray, gap: float, side: float) -> None:
    R = geometry.so3_exp(axis * (math.pi + side * gap))
    omega = geometry.so3_log(R)
    assert np.linalg.norm(omega) <= math.pi + 1e-12
    assert np.linalg.norm(omega) == pytest.approx(math.pi - gap, abs=1e-9)
    assert abs(axis @ omega) == pytest.approx(math.pi - gap, abs=1e-9)
    np.testing.assert_allclose(geometry.so3_exp(omega), R, atol=1e-9)


@given(twists(), twists())
def test_inverse_undoes_one_and_many(first: np.ndarray, second: np.ndarray) -> None:
    stack = np.stack([geometry.se3_exp(first), geometry.se3_exp(second)])
    np.testing.assert_allclose(geometry.inverse(stack) @ stack, np.tile(np.eye(4), (2, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(geometry.inverse(stack[0]), geometry.inverse(stack)[0], atol=0)


@given(twists())
def test_quaternion_round_trip(xi: np.ndarray) -> None:
    R = geometry.so3_exp(xi[:3])
    quat = geometry.quat_wxyz_from_matrix(R)
    assert np.linalg.norm(quat) == pytest.approx(1.0) and quat[0] >= 0
    np.testing.assert_allclose(geometry.matrix_from_quat_wxyz(quat), R, atol=1e-12)
    np.testing.assert_allclose(Rotation.from_matrix(R).as_matrix(), R, atol=1e-9)


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4), st.floats(0.01, 100))
def test_matrices_of_quaternions_of_any_length(values: list[float], scale: float) -> None:
    quat = np.array(values)
    assume(np.linalg.norm(quat) > 1e-2)
    expected = Rotation.from_quat(quat[[1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(geometry.matrix_from_quat_wxyz([quat * scale, quat]), [expected, expected], atol=1e-12)


@given(twists(), twists(), st.floats(0.1, 10))
def test_quaternions_multiply_like_their_matrices(first: np.ndarray, second: np.ndarray, scale: float) -> None:
    R = [geometry.so3_exp(xi[:3]) for xi in (first, second)]
    a, b = (geometry.quat_wxyz_from_matrix(one) for one in R)
    product = geometry.quat_product_wxyz(a, b)
    np.testing.assert_allclose(geometry.matrix_from_quat_wxyz(product), R[0] @ R[1], atol=1e-12)
    scaled = geometry.quat_product_wxyz(scale * a, b)
    assert np.linalg.norm(scaled) == pytest.approx(scale)  # lengths multiply
    both = geometry.quat_product_wxyz([a, b], [b, a])
    np.testing.assert_array_equal(both, [product, geometry.quat_product_wxyz(b, a)])


@given(twists(), st.integers(0, 10_000))
def test_orthonormalized_removes_small_errors(xi: np.ndarray, seed: int) -> None:
    T = geometry.se3_exp(xi)
    noisy = T + np.random.default_rng(seed).normal(size=(4, 4)) * 1e-9
    clean = geometry.orthonormalized(noisy)
    np.testing.assert_allclose(clean[:3, :3] @ clean[:3, :3].T, np.eye(3), atol=1e-14)
    assert np.linalg.det(clean[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(clean, T, atol=1e-7)


@given(twists(), twists())
def test_points_pass_through_a_chain_of_frames(first: np.ndarray, second: np.ndarray) -> None:
    T_ab, T_bc = geometry.se3_exp(first), geometry.se3_exp(second)
    points = np.arange(24.0).reshape(2, 4, 3)
    one = geometry.transform_points(T_ab, geometry.transform_points(T_bc, points))
    np.testing.assert_allclose(geometry.transform_points(T_ab @ T_bc, points), one, atol=1e-9)


@given(st.integers(8, 41), st.integers(8, 41), st.integers(1, 3))
def test_halved_camera_sees_the_averaged_pixels(width: int, height: int, times: int) -> None:
    """An image that holds its own ray directions, averaged, holds those of the halved camera."""
    camera = Camera(width, height, 30.0, 33.0, 17.3, 11.9)
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], -1)
    for _ in range(times):
        rays = rays[: rays.shape[0] // 2 * 2, : rays.shape[1] // 2 * 2]
        rays = cv2.resize(rays, (rays.shape[1] // 2, rays.shape[0] // 2), interpolation=cv2.INTER_AREA)
    half = camera.halved(times)
    assert (half.height, half.width) == rays.shape[:2]
    v, u = np.mgrid[0 : half.height, 0 : half.width].astype(np.float64)
    expected = np.stack([(u - half.cx) / half.fx, (v - half.cy) / half.fy], -1)
    np.testing.assert_allclose(rays, expected, atol=1e-9)


@given(twists(), twists())
def test_adjoint_carries_a_twist_through_a_transform(frame: np.ndarray, xi: np.ndarray) -> None:
    T = geometry.se3_exp(frame)
    small = 0.1 * xi  # so that rounding of the products stays far below the tolerance
    expected = T @ geometry.se3_exp(small) @ geometry.inverse(T)
    np.testing.assert_allclose(geometry.se3_exp(geometry.adjoint(T) @ small), expected, atol=1e-9)


@given(twists(), twists())
def test_adjoints_multiply_and_invert_like_their_transforms(first: np.ndarray, second: np.ndarray) -> None:
    one, other = geometry.se3_exp(first), geometry.se3_exp(second)
    both = geometry.adjoint(one) @ geometry.adjoint(other)
    np.testing.assert_allclose(geometry.adjoint(one @ other), both, atol=1e-11)
    back = geometry.adjoint(geometry.inverse(one)) @ geometry.adjoint(one)
    np.testing.assert_allclose(back, np.eye(6), atol=1e-11)


@given(st.lists(twists(), min_size=1, max_size=6))
def test_many_quaternions_are_those_of_one_at_a_time(xis: list[np.ndarray]) -> None:
    R = np.stack([geometry.so3_exp(xi[:3]) for xi in xis])
    many = geometry.quat_wxyz_from_matrices(R)
    np.testing.assert_array_equal(many, [geometry.quat_wxyz_from_matrix(one) for one in R])
    np.testing.assert_allclose(np.linalg.norm(many, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(geometry.matrix_from_quat_wxyz(many), R, atol=1e-12)
    assert (many[:, 0] >= 0).all()


def test_quaternions_of_half_turns_and_of_no_matrices() -> None:
    """Each of the four components is once the largest: every branch of Shepperd's method."""
    R = np.stack([np.eye(3), *(np.diag(2.0 * axis - 1.0) for axis in np.eye(3))])
    np.testing.assert_allclose(geometry.quat_wxyz_from_matrices(R), np.eye(4), atol=0)
    assert geometry.quat_wxyz_from_matrices(np.zeros((0, 3, 3))).shape == (0, 4)


def test_rotated_rows_are_the_rotated_vectors() -> None:
    R, rows = geometry.se3_exp([0.3, -0.8, 1.1, 0.0, 0.0, 0.0])[:3, :3], np.random.default_rng(0).normal(size=(3, 50))
    np.testing.assert_allclose(geometry.rotate_rows(R, rows), R @ rows, atol=1e-12)
