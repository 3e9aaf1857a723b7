"""Rigid motion of the map: the twin, and a map that moves with its camera."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.reference import rigid as reference
from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.geometry import inverse, se3_exp
from tgslam.map.gaussians import GaussianMap
from tgslam.ops import rigid
from tgslam.ops.rasterize import Rasterizer
from tgslam.types import Gaussians

CAMERA = Camera(48, 40, 60.0, 60.0, 23.5, 19.5)


def gaussians(count: int, births: int, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        mean=(rng.normal(size=(count, 3)) * [0.4, 0.3, 0.2] + [0, 0, 2]).astype(np.float32),
        log_scale=rng.uniform(-4, -2.5, (count, 3)).astype(np.float32),
        quat_wxyz=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logit=rng.uniform(-1, 3, count).astype(np.float32),
        colour=rng.random((count, 3)).astype(np.float32),
        embedding=np.zeros((count, 3), np.float32),
        plane_id=np.full(count, -1, np.int32),
        birth_keyframe=rng.integers(0, births, count).astype(np.int32),
    )


def moved(carriers: np.ndarray, motions: np.ndarray, given_rows: Gaussians, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Centres and quaternions of all rows, after the kernel has moved the first ones."""
    mean, quat = runtime.to_device(given_rows.mean.copy()), runtime.to_device(given_rows.quat_wxyz.copy())
    rigid.move_rows(motions, runtime.to_device(carriers, np.int32), mean, quat, rows)
    return runtime.to_host(mean), runtime.to_host(quat)


@pytest.mark.parametrize("slots", [1, 3, 8])
def test_rows_match_the_twin(slots: int) -> None:
    given_rows, rng = gaussians(300, 4), np.random.default_rng(1)
    motions = np.stack([se3_exp(rng.normal(size=6)) for _ in range(4)])
    carriers = rng.integers(0, 4, (300, slots))
    mean, quat = moved(carriers, motions, given_rows, 200)
    twin_mean, twin_quat = reference.move_rows(carriers, motions, given_rows.mean, given_rows.quat_wxyz)
    np.testing.assert_allclose(mean[:200], twin_mean[:200], atol=2e-6)
    np.testing.assert_allclose(quat[:200], twin_quat[:200], atol=2e-6)
    np.testing.assert_array_equal(mean[200:], given_rows.mean[200:])


def test_the_mean_of_one_motion_is_that_motion_and_of_two_half_way() -> None:
    given_rows, rng = gaussians(60, 1), np.random.default_rng(2)
    motions = np.stack([se3_exp(0.1 * rng.normal(size=6)), np.eye(4)])
    alone = moved(np.zeros((60, 1), np.int32), motions, given_rows, 60)
    eight = moved(np.zeros((60, 8), np.int32), motions, given_rows, 60)
    np.testing.assert_allclose(eight[0], alone[0], atol=1e-6)
    np.testing.assert_allclose(eight[1], alone[1], atol=1e-6)
    half = moved(np.tile(np.array([0, 0, 1, 1], np.int32), (60, 1)), motions, given_rows, 60)
    np.testing.assert_allclose(half[0], 0.5 * (alone[0] + given_rows.mean), atol=1e-6)


@given(st.lists(st.floats(-2, 2), min_size=6, max_size=6))
def test_a_map_and_a_camera_that_move_together_see_the_same(xi: list[float]) -> None:
    motion, rasterizer = se3_exp(xi), Rasterizer(CAMERA)
    still = GaussianMap.from_gaussians(gaussians(80, 1))
    before = rasterizer.render(still, np.eye(4))
    still.move(motion[None])
    after = rasterizer.render(still, inverse(motion))
    np.testing.assert_allclose(after.colour, before.colour, atol=2e-4)
    np.testing.assert_allclose(after.opacity, before.opacity, atol=2e-4)


def test_each_row_follows_its_own_keyframe() -> None:
    moving = GaussianMap.from_gaussians(gaussians(50, 2))
    before = moving.gaussians()
    lift = np.stack([np.eye(4), np.eye(4)])
    lift[1, 1, 3] = 0.5
    moving.move(lift)
    after = moving.gaussians()
    shift = after.mean - before.mean
    np.testing.assert_allclose(shift[:, 1], 0.5 * before.birth_keyframe, atol=1e-6)
    np.testing.assert_allclose(shift[:, [0, 2]], 0.0, atol=1e-6)
    np.testing.assert_allclose(after.quat_wxyz, before.quat_wxyz, atol=1e-6)
