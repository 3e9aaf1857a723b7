"""Relaxation of colours and depths: the twin, and cases whose answer is known."""

import numpy as np
import pytest

from tests.reference import relaxation as reference
from tgslam import runtime
from tgslam.gaussian_map import GaussianMap, MapGradient
from tgslam.geometry import inverse, se3_exp, transform_points
from tgslam.kernels import projection, relaxation
from tgslam.render import ImageGradient, Rasterizer
from tgslam.types import Camera, Gaussians

CAMERA = Camera(40, 32, 60.0, 60.0, 19.5, 15.5)
T_CW = se3_exp([0.3, -0.2, 0.1, 0.4, -0.3, 0.2])
STEPS, FLOORS, MAX_SHIFT = (0.7, 0.3), (2.0, 5.0), 0.0045


def relax(visible, gradient, z, colour, mean, steps=STEPS, floors=FLOORS, max_shift=MAX_SHIFT, T_cw=T_CW):
    """The kernel on copies; returns new colours and means."""
    n = len(z)
    splat_grad = np.zeros((n, projection.SPLAT_GRAD), np.float32)
    splat_grad[:, projection.RED : projection.RED + 3] = gradient["colour"]
    splat_grad[:, projection.Z] = gradient["depth"]
    splat_grad[:, projection.CURVATURE_COLOUR] = gradient["w_colour"]
    splat_grad[:, projection.CURVATURE_DEPTH] = gradient["w_depth"]
    splat = np.zeros((n, projection.SPLAT), np.float32)
    splat[:, projection.Z] = z
    colour, mean = (runtime.to_device(np.array(a, np.float32)) for a in (colour, mean))
    relaxation.relax(
        n, runtime.to_device(visible, np.int32), runtime.to_device(splat_grad), runtime.to_device(splat),
        runtime.to_device(T_cw[:3].reshape(12)), *steps, *floors, max_shift, colour, mean,
    )  # fmt: skip
    return runtime.to_host(colour), runtime.to_host(mean)


def case(n=200, seed=0):
    """Gaussians with gradients of both signs, from far below to far above the floors and the largest shift."""
    rng = np.random.default_rng(seed)
    size = 10.0 ** rng.uniform(-2, 3, n)
    gradient = {
        "colour": size[:, None] * rng.normal(size=(n, 3)),
        "depth": size * 0.03 * rng.normal(size=n),
        "w_colour": 10.0 ** rng.uniform(-1, 3, n),
        "w_depth": 10.0 ** rng.uniform(-1, 3, n),
    }
    z = rng.uniform(0.5, 5.0, n)
    seen = rng.normal(size=(n, 2)) * 0.3 * z[:, None]
    mean = transform_points(inverse(T_CW), np.column_stack([seen, z]))
    return rng.integers(0, 3, n), gradient, z, rng.random((n, 3)), mean


def test_steps_match_the_twin():
    visible, gradient, z, colour, mean = case()
    found = relax(visible, gradient, z, colour, mean)
    expected = reference.relax(visible > 0, gradient, z, T_CW, STEPS, FLOORS, MAX_SHIFT, colour, mean)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=2e-6)


def test_rows_that_were_not_rendered_stay_to_the_bit():
    visible, gradient, z, colour, mean = case()
    found = relax(visible, gradient, z, colour, mean)
    hidden = visible == 0
    assert hidden.any()
    for one, before in zip(found, (colour, mean), strict=True):
        np.testing.assert_array_equal(one[hidden], np.float32(before)[hidden])
        assert (one[~hidden] != np.float32(before)[~hidden]).any(axis=1).mean() > 0.9


def test_depth_steps_are_along_the_ray_and_limited():
    visible, gradient, z, colour, mean = case()
    moved = relax(np.ones_like(visible), gradient, z, colour, mean)[1]
    before, after = (transform_points(T_CW, points) for points in (np.float32(mean), moved))
    np.testing.assert_allclose(after[:, :2] / after[:, 2:], before[:, :2] / before[:, 2:], atol=5e-6)
    shift = after[:, 2] - before[:, 2]
    assert (abs(shift) <= MAX_SHIFT * z**2 + 5e-6).all()
    assert (abs(shift) > MAX_SHIFT * z**2 - 5e-6).mean() > 0.1  # the limit was reached
    downhill = abs(shift) > 5e-6
    np.testing.assert_array_equal(np.sign(shift[downhill]), -np.sign(gradient["depth"][downhill]))


def test_colours_stay_in_range():
    visible, gradient, z, colour, mean = case()
    found = relax(np.ones_like(visible), gradient, z, colour, mean)[0]
    assert found.min() == 0.0 and found.max() == 1.0  # both ends were reached and neither was passed


def test_no_gradient_moves_nothing_even_without_curvature():
    visible, gradient, z, colour, mean = case(20)
    still = {name: np.zeros_like(values) for name, values in gradient.items()}
    found = relax(np.ones_like(visible), still, z, colour, mean)
    np.testing.assert_array_equal(found[0], np.float32(colour))
    np.testing.assert_array_equal(found[1], np.float32(mean))


def one_gaussian():
    """A map of one big Gaussian that faces the camera."""
    return GaussianMap.from_gaussians(
        Gaussians(
            mean=np.float32([[0.05, -0.02, 2.0]]),
            log_scale=np.log(np.float32([[0.2, 0.2, 0.001]])),
            quat_wxyz=np.float32([[1, 0, 0, 0]]),
            opacity_logit=np.float32([2.0]),
            colour=np.float32([[0.3, 0.5, 0.7]]),
            embedding=np.zeros((1, 3), np.float32),
            plane_id=np.int32([-1]),
            birth_keyframe=np.int32([0]),
        )
    )


def backward_and_relax(gaussians, rasterizer, off_colour, off_depth):
    """One full step for these residuals [H, W, 3] and [H, W], all of weight 1."""
    height, width = off_depth.shape
    ones = runtime.to_device(np.ones((height, width)))
    g = ImageGradient(
        runtime.to_device(off_colour), runtime.to_device(off_depth), runtime.zeros((height, width)),
        colour_weight=ones, depth_weight=ones,
    )  # fmt: skip
    rasterizer.backward(gaussians, g, MapGradient.zeros(gaussians.capacity))
    relaxation.relax(
        1, rasterizer.tile_count, rasterizer.splat_grad, rasterizer.splat, runtime.to_device(np.eye(4)[:3].reshape(12)),
        1.0, 1.0, 0.0, 0.0, 1.0, gaussians.colour, gaussians.mean,
    )  # fmt: skip


def test_one_full_step_solves_the_case_of_one_gaussian():
    """Where every pixel asks for the same change, however little of the Gaussian it shows, one step makes it."""
    gaussians, rasterizer = one_gaussian(), Rasterizer(CAMERA)
    wanted, nearer_m = np.array([0.6, 0.2, 0.4]), -0.02
    rasterizer.forward(gaussians, np.eye(4))
    shape = (CAMERA.height, CAMERA.width)
    off_colour = np.broadcast_to(gaussians.host("colour")[0] - wanted, (*shape, 3))
    backward_and_relax(gaussians, rasterizer, off_colour, np.full(shape, -nearer_m))
    np.testing.assert_allclose(gaussians.host("colour")[0], wanted, atol=1e-5)
    np.testing.assert_allclose(gaussians.host("mean")[0], np.array([0.05, -0.02, 2.0]) * 0.99, atol=1e-5)


def test_full_steps_towards_an_image_never_overshoot():
    gaussians, rasterizer = one_gaussian(), Rasterizer(CAMERA)
    wanted = np.array([0.6, 0.2, 0.4])
    before = abs(gaussians.host("colour")[0] - wanted)
    for _ in range(12):
        images = rasterizer.forward(gaussians, np.eye(4))
        opacity = runtime.to_host(images.opacity)
        off_colour = runtime.to_host(images.colour) - opacity[..., None] * wanted
        backward_and_relax(gaussians, rasterizer, off_colour, 0 * opacity)
        after = abs(gaussians.host("colour")[0] - wanted)
        assert (after <= before + 1e-6).all()
        before = after
    assert before.max() < 1e-3


@pytest.mark.parametrize("step", [0.25, 1.0])
def test_the_step_size_scales_the_move(step):
    gradient = {name: np.array([value]) for name, value in {"depth": 1.0, "w_colour": 3.0, "w_depth": 45.0}.items()}
    gradient["colour"] = np.array([[0.5, -0.5, 0.0]])
    found = relax([1], gradient, np.array([2.0]), [[0.5] * 3], [[0.0, 0.0, 2.0]], (step, step), T_cw=np.eye(4))
    np.testing.assert_allclose(found[0][0], [0.5 - step * 0.1, 0.5 + step * 0.1, 0.5], atol=1e-6)
    assert found[1][0, 2] == pytest.approx(2.0 - min(step / 50.0, MAX_SHIFT * 4.0), abs=1e-6)
