"""Flying pixels of depth images, and how much of them is measured."""

import numpy as np
import pytest

from tests.reference import depth as reference
from tgslam.camera import SensorNoise
from tgslam.device import runtime
from tgslam.kernels import depth as kernels
from tgslam.ops import depth

SIGMA = 0.0015
NOISE = SensorNoise(SIGMA)


def keep_supported(depth_m, *settings):
    kept = runtime.empty(depth_m.shape)
    kernels.keep_supported(runtime.to_device(depth_m), *settings, kept)
    return runtime.to_host(kept)


def ragged(height, width, seed=0):
    """Two surfaces with noise, holes and outliers."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width]
    depth_m = np.where(u + v > 0.6 * (height + width), 2.0 + 0.01 * u, 1.0 + 0.005 * v)
    depth_m = depth_m + 0.004 * rng.normal(size=depth_m.shape)
    outlier = rng.random(depth_m.shape) < 0.2
    depth_m[outlier] *= rng.uniform(0.7, 1.5, outlier.sum())
    depth_m[rng.random(depth_m.shape) < 0.2] = 0.0
    return np.float32(depth_m).astype(float)


@pytest.mark.parametrize("size", [(24, 32), (31, 17), (1, 9), (9, 1), (1, 1), (150, 7)])
@pytest.mark.parametrize("minimum", [1, 4, 8])
def test_support_matches_the_twin(size, minimum):
    depth_m, settings = ragged(*size), (SIGMA, 4.2, 0.01, minimum)
    expected = reference.keep_supported(depth_m, *settings)
    np.testing.assert_array_equal(keep_supported(depth_m, *settings), expected)
    if minimum == 4 and min(size) > 10:
        assert 0 < np.count_nonzero(expected) < np.count_nonzero(depth_m)


def test_a_smooth_surface_stays_and_flying_pixels_go():
    v, u = np.mgrid[:40, :60]
    depth_m = np.float32(1.5 + 0.004 * u + 0.002 * v)
    clean = runtime.to_host(depth.without_flying_pixels(runtime.to_device(depth_m), NOISE, 100.0))
    np.testing.assert_array_equal(clean, depth_m)
    flying = depth_m.copy()
    flying[10, 10], flying[20, 30], flying[30, 40:42] = 0.8, 4.0, 2.5  # far from both sides, alone or in pairs
    kept = runtime.to_host(depth.without_flying_pixels(runtime.to_device(flying), NOISE, 100.0))
    assert not kept[flying != depth_m].any()
    np.testing.assert_array_equal(kept[flying == depth_m], depth_m[flying == depth_m])
    assert flying[10, 10] == np.float32(0.8)  # the input is not changed


def test_both_sides_of_an_edge_stay():
    depth_m = np.full((20, 30), 1.0, np.float32)
    depth_m[:, 15:] = 3.0
    kept = depth.without_flying_pixels(runtime.to_device(depth_m), NOISE, 100.0)
    np.testing.assert_array_equal(runtime.to_host(kept), depth_m)


def test_sensor_noise_is_no_reason_to_drop():
    rng = np.random.default_rng(0)
    depth_m = np.float32(3.0 + SIGMA * 9.0 * rng.normal(size=(100, 100)))
    kept = runtime.to_host(depth.without_flying_pixels(runtime.to_device(depth_m), NOISE, 500.0))
    assert (kept > 0).mean() > 0.999


def test_a_nan_measurement_is_dropped():
    depth_m = np.full((9, 9), 2.0, np.float32)
    depth_m[4, 4] = np.nan
    kept = runtime.to_host(depth.without_flying_pixels(runtime.to_device(depth_m), NOISE, 100.0))
    assert kept[4, 4] == 0 and np.count_nonzero(kept) == 80


@pytest.mark.parametrize("size", [(24, 32), (1, 1), (150, 7)])
def test_the_measured_share_counts_every_pixel(size):
    depth_m = ragged(*size)
    assert depth.measured_share(runtime.to_device(depth_m)) == np.count_nonzero(depth_m) / depth_m.size
    assert depth.measured_share(runtime.zeros(size)) == 0.0


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="depth_m"):
        depth.without_flying_pixels(np.zeros((2, 3, 4), np.float32), NOISE, 100.0)
