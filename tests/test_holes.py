"""Guesses for the holes of depth images."""

import numpy as np
import pytest

from tests.test_depth import SIGMA, ragged
from tgslam.map.holes import filled, nearest_measured

FOCAL_PX = 100.0


def plane(height=48, width=64):
    """Inverse depth affine in the pixel."""
    v, u = np.mgrid[:height, :width]
    return np.float32(1.0 / (0.4 + 0.003 * u - 0.002 * v))


@pytest.mark.parametrize("kind", ["random", "block", "grid", "many"])
def test_holes_of_a_plane_are_filled_closely(kind):
    exact_m = plane()
    hole = np.zeros(exact_m.shape, bool)
    rng = np.random.default_rng(1)
    if kind == "block":
        hole[20:28, 30:38] = True
    elif kind == "grid":
        hole[::2], hole[:, ::3] = True, True
    else:
        hole = rng.random(exact_m.shape) < (0.3 if kind == "random" else 0.9)
    depth_m = np.where(hole, np.float32(0.0), exact_m)
    image = filled(depth_m, FOCAL_PX).depth_m
    assert image.dtype == np.float32
    np.testing.assert_array_equal(image[~hole], exact_m[~hole])
    error = abs(image - exact_m)[hole] / exact_m[hole]
    assert np.median(error) < 0.01 and error.max() < 0.06


@pytest.mark.parametrize("width_px", [1, 3, 4, 10])
def test_a_hole_at_an_edge_is_guessed_on_one_of_the_two_surfaces(width_px):
    exact_m = np.where(np.arange(64) < 32, np.float32(1.0), np.float32(3.0)) * np.ones((48, 1), np.float32)
    depth_m = exact_m.copy()
    depth_m[:, 31 : 31 + width_px] = 0.0
    guess = filled(depth_m, FOCAL_PX).depth_m
    assert set(np.unique(guess)) == {1.0, 3.0}
    assert (np.diff(guess, axis=1) >= 0).all()


def test_what_is_too_grazing_for_depth_is_not_guessed_in_the_air():
    """A box 1 m off before a wall: guesses for its side, 0.3 m deep, are within 2 cm of a surface."""
    focal_px, corner_m, wall_m = 277.0, 0.126, 2.4
    ratio = (np.arange(64) * np.ones((48, 1)) - 1.0) / focal_px  # x / z
    front, side = ratio > corner_m, (ratio <= corner_m) & (ratio > corner_m / 1.3)
    depth_m = np.where(side, 0.0, np.where(front, 1.0, wall_m)).astype(np.float32)
    guess = filled(depth_m, focal_px)
    z = guess.depth_m[side].astype(np.float64)
    x = ratio[side] * z
    off_m = np.stack(
        [
            np.hypot(np.maximum(corner_m - x, 0.0), z - 1.0),
            np.hypot(x - corner_m, z - np.clip(z, 1.0, 1.3)),
            np.abs(z - wall_m),
        ]
    )
    assert side[0].sum() == 8
    assert off_m.min(axis=0).max() < 0.01
    beyond = guess.source >= 0
    np.testing.assert_array_equal(beyond.sum(axis=1), 4)  # all but two pixels at either side
    np.testing.assert_array_equal(guess.depth_m[beyond], np.float32(wall_m))
    np.testing.assert_array_equal(depth_m.ravel()[guess.source[beyond]], np.float32(wall_m))


def test_a_floor_that_becomes_too_grazing_goes_on_to_the_wall():
    """A floor 0.5 m below the camera, without depth from 2.2 m on, before a wall at 6 m."""
    focal_px = 277.0
    down = (np.arange(100)[:, None] - 5.0) / focal_px * np.ones((1, 80))
    floor_m = 0.5 / np.maximum(down, 1e-6)
    exact_m = np.minimum(floor_m, 6.0)
    hole = (floor_m > 2.2) & (floor_m < 6.0)
    noise = 1.0 + SIGMA * np.random.default_rng(0).normal(size=exact_m.shape) * exact_m
    guess = filled(np.where(hole, 0.0, exact_m * noise).astype(np.float32), focal_px)
    assert hole.sum() > 1000 and not (guess.source >= 0).any()
    error = abs(guess.depth_m - exact_m)[hole] / exact_m[hole]
    assert np.median(error) < 0.1 and error.max() < 0.3


def test_a_wide_hole_in_a_slope_is_bridged():
    exact_m = plane()
    depth_m = exact_m.copy()
    depth_m[:, 20:44] = 0.0
    guess = filled(depth_m, FOCAL_PX).depth_m
    constant = depth_m.ravel()[nearest_measured(depth_m)]
    assert abs(guess - exact_m).mean() < 0.5 * abs(constant - exact_m).mean()


def test_the_nearest_measurement_is_the_nearest_one():
    depth_m = np.float32(ragged(20, 30, seed=5))
    depth_m[4:15, 8:22] = 0.0
    rows, columns = np.nonzero(depth_m)
    found_rows, found_columns = np.divmod(nearest_measured(depth_m), 30)
    assert (depth_m[found_rows, found_columns] > 0).all()
    v, u = np.mgrid[:20, :30]
    least = np.hypot(v[..., None] - rows, u[..., None] - columns).min(-1)
    assert (np.hypot(v - found_rows, u - found_columns) <= 1.05 * least + 1e-9).all()


def test_guesses_stay_between_the_nearest_and_the_farthest_measurement():
    depth_m = np.float32(ragged(45, 33, seed=4))
    image = filled(depth_m, FOCAL_PX).depth_m
    known = depth_m[depth_m > 0]
    assert image.min() >= known.min() * (1 - 1e-5) and image.max() <= known.max() * (1 + 1e-5)
    np.testing.assert_array_equal(image[depth_m > 0], known)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1), (2, 3), (33, 17)])
def test_a_single_measurement_fills_the_image(size):
    depth_m = np.zeros(size, np.float32)
    depth_m[-1, size[1] // 2] = 2.5
    np.testing.assert_allclose(filled(depth_m, FOCAL_PX).depth_m, 2.5, rtol=1e-5)


def test_nothing_to_fill_or_to_fill_from():
    full, empty = plane(), np.zeros((7, 9), np.float32)
    np.testing.assert_array_equal(filled(full, FOCAL_PX).depth_m, full)
    np.testing.assert_array_equal(filled(empty, FOCAL_PX).depth_m, empty)


def test_filling_leaves_its_input_alone():
    depth_m = np.float32(ragged(20, 30))
    before = depth_m.copy()
    filled(depth_m, FOCAL_PX)
    np.testing.assert_array_equal(depth_m, before)
