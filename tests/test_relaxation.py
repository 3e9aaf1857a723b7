"""Relaxation of colours: the twin, and cases whose answer is known."""

import numpy as np
import pytest

from tests.reference import relaxation as reference
from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.kernels import relaxation
from tgslam.kernels.objective import PIXELS, TOTALS
from tgslam.map.gaussians import GaussianMap
from tgslam.ops.rasterize import ImageGradient, Rasterizer
from tgslam.ops.splats import MapGradient
from tgslam.types import Gaussians

CAMERA = Camera(40, 32, 60.0, 60.0, 19.5, 15.5)
STEP, FLOOR = 0.7, 2.0


def totals():
    """Sums of a loss over one pixel, so that its weight is a pixel's curvature."""
    sums = np.zeros(TOTALS, np.float32)
    sums[PIXELS] = 1.0
    return runtime.to_device(sums)


def relax(visible, grad_colour, w_colour, colour, step=STEP, floor=FLOOR):
    """The kernel on a copy; returns the new colours."""
    n = len(colour)
    curvature = np.full((n, 2), 1e6, np.float32)  # the depth's column must not matter
    curvature[:, 0] = w_colour
    colour = runtime.to_device(np.array(colour, np.float32))
    relaxation.relax(
        n, runtime.to_device(visible, np.int32), runtime.to_device(grad_colour), runtime.to_device(curvature),
        totals(), step, floor, colour,
    )  # fmt: skip
    return runtime.to_host(colour)


def case(n=200, seed=0):
    """Which are visible, gradients of both signs from far below to far above the floor, curvatures and colours."""
    rng = np.random.default_rng(seed)
    grad_colour = 10.0 ** rng.uniform(-2, 3, (n, 1)) * rng.normal(size=(n, 3))
    return rng.integers(0, 3, n), grad_colour, 10.0 ** rng.uniform(-1, 3, n), rng.random((n, 3))


def test_steps_match_the_twin():
    visible, grad_colour, w_colour, colour = case()
    expected = reference.relax(visible > 0, grad_colour, w_colour, STEP, FLOOR, colour)
    np.testing.assert_allclose(relax(visible, grad_colour, w_colour, colour), expected, atol=2e-6)


def test_rows_that_were_not_rendered_stay_to_the_bit():
    visible, grad_colour, w_colour, colour = case()
    found = relax(visible, grad_colour, w_colour, colour)
    hidden = visible == 0
    assert hidden.any()
    np.testing.assert_array_equal(found[hidden], np.float32(colour)[hidden])
    assert (found[~hidden] != np.float32(colour)[~hidden]).any(axis=1).mean() > 0.9


def test_colours_stay_in_range():
    visible, grad_colour, w_colour, colour = case()
    found = relax(np.ones_like(visible), grad_colour, w_colour, colour)
    assert found.min() == 0.0 and found.max() == 1.0  # both ends were reached and neither was passed


def test_no_gradient_moves_nothing_even_with_hardly_any_curvature():
    visible, grad_colour, w_colour, colour = case(20)
    found = relax(np.ones_like(visible), 0 * grad_colour, 0 * w_colour, colour, floor=1e-6)
    np.testing.assert_array_equal(found, np.float32(colour))


def test_a_loss_without_curvature_leaves_colours_alone():
    visible, grad_colour, w_colour, colour = case(20)
    found = relax(np.ones_like(visible), grad_colour, 0 * w_colour, colour, floor=0.0)
    np.testing.assert_array_equal(found, np.float32(colour))


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


def backward_and_relax(gaussians, rasterizer, off_colour):
    """One full step for these residuals [H, W, 3], all of weight 1."""
    shape = (CAMERA.height, CAMERA.width)
    ones, no = runtime.to_device(np.ones(shape)), runtime.zeros(shape)
    gradient = MapGradient.zeros(gaussians.capacity)
    g = ImageGradient(runtime.to_device(off_colour), no, no, colour_weight=ones, depth_weight=ones)
    rasterizer.backward(gaussians, g, gradient)
    relaxation.relax(
        1, rasterizer.tile_count, gradient.colour, gradient.curvature, totals(), 1.0, 0.0, gaussians.colour
    )


def test_one_full_step_solves_the_case_of_one_gaussian():
    """Where every pixel asks for the same change, however little of the Gaussian it shows, one step makes it."""
    gaussians, rasterizer = one_gaussian(), Rasterizer(CAMERA)
    wanted = np.array([0.6, 0.2, 0.4])
    rasterizer.forward(gaussians, np.eye(4))
    off_colour = np.broadcast_to(gaussians.host("colour")[0] - wanted, (CAMERA.height, CAMERA.width, 3))
    backward_and_relax(gaussians, rasterizer, off_colour)
    np.testing.assert_allclose(gaussians.host("colour")[0], wanted, atol=1e-5)


def test_full_steps_towards_an_image_never_overshoot():
    gaussians, rasterizer = one_gaussian(), Rasterizer(CAMERA)
    wanted = np.array([0.6, 0.2, 0.4])
    side = np.sign(gaussians.host("colour")[0] - wanted)
    before = abs(gaussians.host("colour")[0] - wanted)
    for _ in range(12):
        images = rasterizer.forward(gaussians, np.eye(4))
        off_colour = runtime.to_host(images.colour) - runtime.to_host(images.opacity)[..., None] * wanted
        backward_and_relax(gaussians, rasterizer, off_colour)
        off = gaussians.host("colour")[0] - wanted
        assert (side * off >= -1e-6).all()
        assert (abs(off) <= before + 1e-6).all()
        before = abs(off)
    assert before.max() < 1e-3


@pytest.mark.parametrize("step", [0.25, 1.0])
def test_the_step_size_scales_the_move(step):
    found = relax([1], [[0.5, -0.5, 0.0]], [3.0], [[0.5] * 3], step)
    np.testing.assert_allclose(found[0], [0.5 - step * 0.1, 0.5 + step * 0.1, 0.5], atol=1e-6)
