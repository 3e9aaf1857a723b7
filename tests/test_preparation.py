"""What frames go through before they are tracked: what is dropped, and which frames are refused."""

from __future__ import annotations

import numpy as np
import pytest

from tgslam.camera import Camera, SensorNoise
from tgslam.device import runtime
from tgslam.errors import FrameError
from tgslam.preparation import Preparation, without_range_limit
from tgslam.types import Frame

CAMERA = Camera(60, 40, 100.0, 100.0, 29.5, 19.5)
NOISE = SensorNoise(0.0015)


def frame(depth_m: np.ndarray) -> Frame:
    """With a grey image of the camera's size."""
    return Frame(7, 0.5, np.full((*CAMERA.shape, 3), 0.5, np.float32), depth_m.astype(np.float32))


def slope() -> np.ndarray:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.float32(1.5 + 0.004 * u + 0.002 * v)


def test_a_sound_frame_is_as_it_was() -> None:
    given = frame(slope())
    prepared = Preparation(CAMERA, NOISE)(given)
    assert (prepared.index, prepared.timestamp_s) == (7, 0.5)
    np.testing.assert_array_equal(runtime.to_host(prepared.depth_m), slope())
    np.testing.assert_array_equal(runtime.to_host(prepared.colour), given.colour)


def test_flying_pixels_and_what_ends_out_of_range_are_dropped() -> None:
    depth_m = slope()
    depth_m[10, 10] = 0.8
    depth_m[:, 40:] = np.where(np.random.default_rng(0).random((40, 20)) < 0.3, 6.9, 0.0)
    given = frame(depth_m)
    kept = runtime.to_host(Preparation(CAMERA, NOISE)(given).depth_m)
    assert kept[10, 10] == 0.0 and not kept[:, 40:].any()
    inside = np.ones(CAMERA.shape, bool)
    inside[10, 10], inside[:, 30:] = False, False
    np.testing.assert_array_equal(kept[inside], depth_m[inside])
    np.testing.assert_array_equal(given.depth_m, depth_m)  # the input is not changed


def test_noise_says_what_flies() -> None:
    depth_m = slope()
    depth_m[10, 10] += 0.15
    kept = [runtime.to_host(Preparation(CAMERA, noise)(frame(depth_m)).depth_m) for noise in (NOISE, SensorNoise(0.02))]
    assert kept[0][10, 10] == 0.0 and kept[1][10, 10] > 0.0


@pytest.mark.parametrize("shape", [(40, 59), (39, 60)])
def test_images_of_another_size_are_refused(shape: tuple[int, int]) -> None:
    message = r"frame 7: {} must be an array of shape \[40, 60.*, but is \[\d+, \d+"
    with pytest.raises(FrameError, match=message.format("depth_m")):
        Preparation(CAMERA, NOISE)(frame(np.ones(shape)))
    colour = np.zeros((*shape, 3), np.float32)
    with pytest.raises(FrameError, match=message.format("colour")):
        Preparation(CAMERA, NOISE)(Frame(7, 0.0, colour, slope()))


def test_next_to_no_depth_is_refused() -> None:
    depth_m = np.zeros(CAMERA.shape)
    depth_m[:3, :7] = 1.5
    with pytest.raises(FrameError, match="frame 7: depth in less than 1% of its pixels"):
        Preparation(CAMERA, NOISE)(frame(depth_m))


@pytest.mark.parametrize("beyond_sigmas", [-0.7, -0.3, 0.0, 1.0])
def test_a_wall_that_noise_brings_into_range_is_dropped(beyond_sigmas: float) -> None:
    range_m = 7.0
    sigma_m = NOISE.per_m2 * range_m**2
    noise_m = sigma_m * np.random.default_rng(0).normal(size=(120, 160))
    wall_m = range_m + beyond_sigmas * sigma_m
    seen_m = wall_m + noise_m
    depth_m = np.where(seen_m < range_m, seen_m, 0.0).astype(np.float32)
    depth_m[:, :60] = 5.0
    kept = without_range_limit(depth_m, NOISE)
    assert (kept[:, 70:] > 0).mean() < 0.1
    np.testing.assert_array_equal(kept[:, :60], 5.0)


def test_a_wall_within_range_keeps_its_depth_and_holes_cost_a_few_pixels() -> None:
    depth_m = (4.0 + 0.0015 * 16.0 * np.random.default_rng(0).normal(size=(120, 160))).astype(np.float32)
    np.testing.assert_array_equal(without_range_limit(depth_m, NOISE), depth_m)
    seam = depth_m.copy()
    seam[:, 80:82] = 0.0
    np.testing.assert_array_equal(without_range_limit(seam, NOISE), seam)
    depth_m[50:60, 70:90] = 0.0
    lost = (depth_m > 0) & (without_range_limit(depth_m, NOISE) == 0)
    assert lost.sum() < 300
    assert not lost[:44].any() and not lost[66:].any()
    empty = np.zeros((9, 9), np.float32)
    np.testing.assert_array_equal(without_range_limit(empty, NOISE), empty)
