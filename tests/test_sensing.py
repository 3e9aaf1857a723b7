"""The noise of a sensor and the size of a scene, learnt from depth images whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from tgslam.camera import Camera
from tgslam.config.input_settings import SyntheticConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.sensing import learn_noise, likelier_scale, median_depth_m, reach_m, unit_of
from tgslam.synthetic.sensor import DEPTH_SIGMA_PER_M2

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)


def corner(size: float = 1.0) -> np.ndarray:
    """Exact depth [H, W] of two walls and a floor, from 1.6 to 3.4 m, times a size."""
    rays = CAMERA.rays()
    planes = np.array([[0.5, 0.0, -0.87, 3.0], [-0.6, 0.1, -0.79, 2.5], [0.0, -0.98, -0.17, 1.0]])
    with np.errstate(divide="ignore"):
        z = -planes[:, 3] / (rays @ planes[:, :3].T)
    return size * np.where(z > 0, z, np.inf).min(axis=-1)


def measured(depth_m: np.ndarray, sigma_m: np.ndarray, holes: float = 0.0, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noisy = depth_m + sigma_m * rng.standard_normal(depth_m.shape)
    return np.where(rng.random(depth_m.shape) < holes, 0.0, np.maximum(noisy, 0.0)).astype(np.float32)


@pytest.mark.parametrize("scene", ["room", "desk", "corridor"])
@pytest.mark.parametrize("factor", [0.3, 1.0, 3.0, 10.0])
def test_noise_of_the_built_in_scenes_is_learnt(scene: str, factor: float) -> None:
    config = SyntheticConfig(scene=scene, frames=300, width=320, height=240, noise_factor=factor)
    source = SyntheticSource(config, seed=0)
    for index in (0, 150):
        depth_m = source.read(index).depth_m
        learnt = learn_noise(depth_m)
        assert learnt is not None
        found = learnt.equivalent_per_m2(median_depth_m(depth_m))
        assert found == pytest.approx(factor * DEPTH_SIGMA_PER_M2, rel=0.3)


@pytest.mark.parametrize("size", [0.1, 1.0, 10.0])
@pytest.mark.parametrize("holes", [0.0, 0.5])
@pytest.mark.parametrize("per_m2", [0.0003, 0.0015, 0.015])
def test_noise_that_grows_with_the_square_of_depth(per_m2: float, holes: float, size: float) -> None:
    depth_m = corner(size)
    per_m2 /= size
    learnt = learn_noise(measured(depth_m, per_m2 * depth_m**2, holes))
    assert learnt is not None
    assert learnt.per_m2 == pytest.approx(per_m2, rel=0.15)
    assert learnt.floor_m < 0.3 * per_m2 * np.median(depth_m) ** 2


def test_noise_that_is_the_same_at_all_depths() -> None:
    """As of a time-of-flight camera."""
    learnt = learn_noise(measured(corner(), np.full(CAMERA.shape, 0.008)))
    assert learnt is not None
    np.testing.assert_allclose(learnt.sigma_m(np.array([1.5, 2.5, 3.5])), 0.008, rtol=0.2)


def test_noise_with_a_floor() -> None:
    depth_m = corner()
    truth = np.hypot(0.006, 0.002 * depth_m**2)
    learnt = learn_noise(measured(depth_m, truth))
    assert learnt is not None
    at = np.array([1.7, 2.6, 3.3])
    np.testing.assert_allclose(learnt.sigma_m(at), np.hypot(0.006, 0.002 * at**2), rtol=0.2)


@pytest.mark.parametrize("step_m", [0.001, 0.01])
def test_steps_are_seen_and_count_as_noise(step_m: float) -> None:
    """Depth without noise in steps: a surface that faces the camera lies within one of them."""
    depth_m = (np.rint(corner() / step_m) * step_m).astype(np.float32)
    learnt = learn_noise(depth_m)
    assert learnt is not None
    middle = median_depth_m(depth_m)
    assert learnt.step * middle == pytest.approx(step_m, rel=0.2)
    assert learnt.sigma_m(middle) == pytest.approx(step_m / np.sqrt(12), rel=0.3)


def test_edges_and_clutter_do_not_count_as_noise() -> None:
    """Steps of a metre through two windows in three."""
    depth_m, columns = corner(), np.arange(CAMERA.width)
    depth_m[:, (columns // 10) % 2 == 0] += 1.0
    learnt = learn_noise(measured(depth_m, 0.002 * depth_m**2))
    assert learnt is not None
    assert learnt.per_m2 == pytest.approx(0.002, rel=0.3)


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_an_image_with_next_to_no_depth_says_nothing(share: float) -> None:
    assert learn_noise(measured(corner(), np.zeros(CAMERA.shape), holes=1.0 - share)) is None


@pytest.mark.parametrize("size", [0.003, 0.01, 0.1, 0.4, 0.5, 1.0, 3.0, 5.0, 30.0, 1000.0])
def test_the_unit_makes_any_world_a_room(size: float) -> None:
    depth_m = corner(size).astype(np.float32)
    reach = reach_m(depth_m)
    assert reach == pytest.approx(np.quantile(depth_m, 0.95), rel=0.02)
    unit = unit_of(reach)
    assert np.log2(unit) == round(np.log2(unit))
    assert 1.5 / np.sqrt(2) < reach / unit < 8.0 * np.sqrt(2)
    assert (unit == 1.0) == (0.3 < size < 5.0)


def test_no_depth_tells_no_unit() -> None:
    assert unit_of(reach_m(np.zeros(CAMERA.shape, np.float32))) == 1.0


def test_a_near_thing_does_not_make_a_room_small() -> None:
    depth_m = corner().astype(np.float32)
    depth_m[:, :256] = 0.2
    assert unit_of(reach_m(depth_m)) == 1.0


@pytest.mark.parametrize("noise", [0.6, 1.0, 1.6])
@pytest.mark.parametrize(("read_by", "right"), [(5000.0, 1000.0), (1000.0, 5000.0)])
def test_a_room_that_was_read_by_the_other_customary_scale_is_told(read_by: float, right: float, noise: float) -> None:
    size, per_m2 = right / read_by, noise * DEPTH_SIGMA_PER_M2
    assert likelier_scale(read_by, per_m2 / size, 3.5 * size) == right
    assert likelier_scale(right, per_m2, 3.5) is None


@pytest.mark.parametrize(
    ("scale", "noise", "reach"),
    [
        (5000.0, 10.0, 3.5),  # a noisy sensor in a room
        (5000.0, 1.0, 0.7),  # a sensor close to a small thing
        (5000.0, 0.1, 0.7),  # a good one
        (50_000.0, 5.0, 0.7),  # nobody takes such a scale by mistake
        (1000.0, 1.0, 3.5),
    ],
)
def test_what_another_scale_would_not_explain_is_believed(scale: float, noise: float, reach: float) -> None:
    assert likelier_scale(scale, noise * DEPTH_SIGMA_PER_M2, reach) is None
