"""E_str: values and gradients against the float64 twin, and where Gaussians go under it."""

from dataclasses import replace

import numpy as np
import pytest

from tests.reference import plane_regularisers as reference
from tests.test_loss_kernels import assert_gradient, central
from tests.tiers import changed
from tgslam.config.plane_settings import StructureConfig
from tgslam.device import runtime
from tgslam.geometry import matrix_from_quat_wxyz
from tgslam.map.gaussians import GaussianMap
from tgslam.ops.plane_regularisers import PlaneRegularisers
from tgslam.ops.splats import MapGradient
from tgslam.types import Gaussians

CONFIG = changed(
    StructureConfig(), lambda_str=0.6, omega_flat=1.3, omega_normal=0.8, omega_distance=0.4, sigma_distance_m=0.01
)
PARTS = ("flat", "normal", "distance")
MOVED = ("mean", "log_scale", "quat_wxyz")


def scene(n=77, seed=0):
    """Gaussians of all sizes and shapes; planes of which one is none; ids without a row; which are visible."""
    rng = np.random.default_rng(seed)
    planes = rng.normal(size=(5, 4))
    planes[:, :3] /= np.linalg.norm(planes[:, :3], axis=1, keepdims=True)
    planes[3] = 0.0
    plane_id = rng.integers(-1, 7, n).astype(np.int32)
    on = planes[np.clip(plane_id, 0, 4)]
    mean = rng.normal(size=(n, 3))
    mean -= ((mean * on[:, :3]).sum(1) + on[:, 3] + 0.02 * rng.normal(size=n))[:, None] * on[:, :3]
    gaussians = Gaussians(
        mean=mean.astype(np.float32),
        log_scale=(rng.uniform(-7, -1, (n, 1)) + 0.8 * rng.normal(size=(n, 3))).astype(np.float32),
        quat_wxyz=rng.normal(size=(n, 4)).astype(np.float32),
        opacity_logit=np.zeros(n, np.float32),
        colour=np.zeros((n, 3), np.float32),
        embedding=np.zeros((n, 3), np.float32),
        plane_id=plane_id,
        birth_keyframe=np.zeros(n, np.int32),
    )
    return gaussians, np.float32(planes).astype(float), rng.integers(0, 3, n).astype(np.int32)


def evaluate(gaussians, planes, visible, config=CONFIG):
    """Gradients by parameter, and the parts."""
    device = GaussianMap.from_gaussians(gaussians)
    into, regularisers = MapGradient.zeros(device.capacity), PlaneRegularisers(config)
    regularisers.add(device, runtime.to_device(visible, np.int32), runtime.to_device(planes), into)
    return {name: runtime.to_host(getattr(into, name)) for name in vars(into)}, regularisers.parts


def twin_arguments(gaussians, planes, visible, config=CONFIG):
    """Float64 parameters, and the arguments of the twin that hold them."""
    parameters = [getattr(gaussians, name).astype(float) for name in MOVED]
    use = reference.planar(visible, gaussians.plane_id, planes)
    areas = reference.unit_areas(parameters[1])
    return parameters, (*parameters, areas, use, gaussians.plane_id, planes, config)


def test_values_match_the_twin():
    case = scene(300)
    _, arguments = twin_arguments(*case)
    _, found = evaluate(*case)
    expected = reference.parts(*arguments)
    assert 0 < found["count"] == arguments[4].sum() < 200
    for part in PARTS:
        assert found[part] == pytest.approx(expected[part], rel=2e-4), part


@pytest.mark.parametrize("part", [*PARTS, "all"])
def test_gradients_match_central_differences(part):
    config = CONFIG if part == "all" else changed(CONFIG, **{f"omega_{p}": float(p == part) for p in PARTS})
    case = scene()
    parameters, arguments = twin_arguments(*case, config)
    found, _ = evaluate(*case, config)
    for name, parameter in zip(MOVED, parameters, strict=True):
        expected = central(lambda: reference.value(*arguments), parameter, 1e-6)
        if expected.any():
            assert_gradient(found[name], expected)
        else:
            assert not found[name].any(), name
    assert not any(found[name].any() for name in found.keys() - set(MOVED))
    assert not any(found[name][~arguments[4]].any() for name in MOVED)


def test_gradients_are_added():
    gaussians, planes, visible = scene()
    once, _ = evaluate(gaussians, planes, visible)
    device, regularisers = GaussianMap.from_gaussians(gaussians), PlaneRegularisers(CONFIG)
    into = MapGradient.zeros(device.capacity)
    for _ in range(2):
        regularisers.add(device, runtime.to_device(visible, np.int32), runtime.to_device(planes), into)
    np.testing.assert_allclose(runtime.to_host(into.quat_wxyz), 2 * once["quat_wxyz"], rtol=1e-6)


def test_no_planar_gaussian_gives_zero_not_nan():
    gaussians, planes, visible = scene()
    found, parts = evaluate(gaussians, planes, 0 * visible)
    assert parts == dict.fromkeys((*PARTS, "count"), 0.0)
    assert not any(gradient.any() for gradient in found.values())


def test_size_does_not_matter_for_flatness():
    gaussians, planes, visible = scene()
    config = changed(CONFIG, omega_normal=0.0, omega_distance=0.0)
    larger = replace(gaussians, log_scale=gaussians.log_scale + np.float32(2.0))
    small, large = (evaluate(g, planes, visible, config)[0]["log_scale"] for g in (gaussians, larger))
    np.testing.assert_allclose(large, small, rtol=1e-4, atol=1e-8)


def test_descent_flattens_aligns_and_moves_onto_the_plane_what_is_near_it():
    n, near = 40, np.arange(40) < 20
    gaussians, planes, _ = scene(n)
    heights = np.where(near, np.linspace(-0.015, 0.045, n), np.linspace(-0.3, 0.9, n))
    means = gaussians.mean + (heights - gaussians.mean @ planes[2, :3] - planes[2, 3])[:, None] * planes[2, :3]
    gaussians = replace(gaussians, plane_id=np.full(n, 2, np.int32), mean=means.astype(np.float32))
    device, regularisers = GaussianMap.from_gaussians(gaussians), PlaneRegularisers(CONFIG)
    visible, table = runtime.to_device(np.ones(n), np.int32), runtime.to_device(planes)
    for _ in range(600):
        into = MapGradient.zeros(device.capacity)
        regularisers.add(device, visible, table, into)
        device.mean[:] = device.mean - 2e-4 * n * into.mean
        for name in ("log_scale", "quat_wxyz"):
            getattr(device, name)[:] = getattr(device, name) - 0.3 * n * getattr(into, name)
    rotations = matrix_from_quat_wxyz(device.host("quat_wxyz").astype(float))
    minor = rotations[np.arange(n), :, device.host("log_scale").argmin(1)]
    assert np.median(abs(minor @ planes[2, :3])) > 0.999
    reached = device.host("mean") @ planes[2, :3] + planes[2, 3]
    assert abs(reached[near]).max() < 1e-4
    np.testing.assert_allclose(reached[~near], heights[~near], atol=1e-3)  # on another surface
    scales = np.sort(np.exp(device.host("log_scale")), axis=1)
    np.testing.assert_allclose(
        scales[:, 0] / np.sqrt(scales[:, 1] * scales[:, 2]), CONFIG.expert.shape.thinness, atol=0.02
    )
