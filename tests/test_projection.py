"""The projection's kernels where 16 Gaussians at a time could go wrong: parts of blocks, and what is not drawn."""

import numpy as np
import pytest
import taichi as ti

from tests.reference.projection import NAMES, parameters, project
from tests.test_render import (
    CAMERA,
    POSE,
    Functional,
    assert_images_match,
    assert_renders_nothing,
    check_directions,
    make_gaussians,
    random_gaussians,
)
from tgslam.device import runtime
from tgslam.kernels import projection
from tgslam.kernels.simd import LANES, Lanes, exponential, lanes_kernel
from tgslam.map.gaussians import PARAMETERS, GaussianMap
from tgslam.ops.rasterize import Rasterizer
from tgslam.ops.splats import MapGradient
from tgslam.types import Gaussians

COUNTS = (1, LANES - 1, LANES, LANES + 1, 2 * LANES + 1)
_VIEW_AXIS = POSE[2, :3].astype(np.float32)  # world


@lanes_kernel
def _functions(
    x: ti.types.ndarray(Lanes, ndim=2),  # [N, 1]
    result: ti.types.ndarray(Lanes, ndim=2),  # [N, 3] exp, sigmoid, softplus
):
    for i in range(x.shape[0]):
        result[i, 0] = exponential(x[i, 0])
        result[i, 1] = projection.sigmoid(x[i, 0])
        result[i, 2] = projection.softplus(x[i, 0])


def _of_lanes(x: np.ndarray) -> np.ndarray:
    """[3, N]: exp, sigmoid and softplus of x [N], N a multiple of 16."""
    rows = len(x) // LANES
    argument, result = runtime.empty((rows, 1, LANES), lanes=True), runtime.empty((rows, 3, LANES), lanes=True)
    argument[:, 0] = x.reshape(rows, LANES)
    _functions(argument, result)
    return np.moveaxis(result, 1, 0).reshape(3, -1)


def test_functions_of_lanes() -> None:
    """exp is good to the rounding of its argument times 1/log 2, which has that argument's size; the others follow."""
    x = np.concatenate([np.linspace(-44.0, 43.5, 1 << 14), np.linspace(-1.0, 1.0, 1 << 12)]).astype(np.float32)
    exact = x.astype(np.float64)
    exp, sigmoid, softplus = _of_lanes(x)
    bound = 1.2e-7 * (1.0 + np.abs(exact))
    assert (np.abs(exp / np.exp(exact) - 1.0) < bound).all()
    assert (np.abs(sigmoid * (1.0 + np.exp(-exact)) - 1.0) < 2.0 * bound).all()
    assert (np.abs(softplus / np.logaddexp(0.0, exact) - 1.0) < 3.0 * bound).all()


def test_functions_of_lanes_beyond_their_range() -> None:
    x = np.repeat(np.float32([-1e30, -100.0, 100.0, 1e30]), 4)
    exp, sigmoid, softplus = _of_lanes(x)
    np.testing.assert_array_equal(exp[:8], np.float32(2.0**-64))
    np.testing.assert_array_equal(exp[8:], np.float32(2.0**63))
    np.testing.assert_allclose(sigmoid, np.repeat([0.0, 0.0, 1.0, 1.0], 4), atol=1e-18)
    np.testing.assert_allclose(softplus[:8], 0.0, atol=1e-18)
    np.testing.assert_array_equal(softplus[8:], x[8:])


@pytest.mark.parametrize("count", COUNTS)
def test_any_number_of_gaussians(count: int) -> None:
    gaussians = random_gaussians(count, CAMERA, seed=count)
    assert_images_match(gaussians, POSE, CAMERA)
    check_directions(gaussians, POSE, CAMERA)


@pytest.mark.parametrize("count", COUNTS)
def test_any_number_of_gaussians_behind_the_camera(count: int) -> None:
    rng = np.random.default_rng(count)
    mean = rng.normal(size=(count, 3)) * [1.0, 1.0, 0.0]
    mean[:, 2] = np.resize([-1.0, 0.0, 0.049, -1e-6, 0.0], count)
    mean[::3, :2] = 0.0  # the camera's centre is among them
    assert_renders_nothing(make_gaussians(mean=mean, opacity_logit=np.full(count, 3.0)))


@pytest.mark.parametrize("count", COUNTS)
def test_rows_beyond_the_count_are_neither_read_nor_written(count: int) -> None:
    gaussians = random_gaussians(count, CAMERA, seed=count)
    gaussian_map = GaussianMap(3 * LANES)
    gaussian_map.append(gaussians)
    into = MapGradient.zeros(gaussian_map.capacity)
    for name in PARAMETERS:
        getattr(gaussian_map, name)[count:] = np.nan
        getattr(into, name)[count:] = 7.0
    rasterizer = Rasterizer(CAMERA)
    images = rasterizer.forward(gaussian_map, POSE, with_embedding=True)
    pose = rasterizer.backward(gaussian_map, Functional(parameters(gaussians), POSE, CAMERA).image_gradient(), into)
    assert np.isfinite(images.depth).all() and np.isfinite(pose).all()
    for name in PARAMETERS:
        assert np.isfinite(getattr(into, name)[:count]).all(), name
        assert (getattr(into, name)[count:] == 7.0).all(), name


def _with_others_between(front: Gaussians) -> tuple[Gaussians, np.ndarray]:
    """The Gaussians among others that nobody sees, and where they are: first those behind, then all others mixed."""
    n = len(front)
    behind, beside, faint = ({name: getattr(front, name).copy() for name in NAMES} for _ in range(3))
    behind["mean"] -= np.float32(10.0) * _VIEW_AXIS
    beside["mean"] += np.float32(30.0) * POSE[0, :3].astype(np.float32)
    faint["opacity_logit"][:] = -9.0
    fields = {name: np.concatenate([behind[name], getattr(front, name), beside[name], faint[name]]) for name in NAMES}
    order = np.concatenate([np.arange(n), n + np.random.default_rng(27).permutation(3 * n)])
    return make_gaussians(**{name: values[order] for name, values in fields.items()}), np.flatnonzero(
        (order >= n) & (order < 2 * n)
    )


def test_what_is_not_drawn_changes_nothing() -> None:
    """Behind the camera, beside the image or too faint, in blocks of their own or among others: bit for bit."""
    front = random_gaussians(2 * LANES + 3, CAMERA, seed=28)
    mixture, place = _with_others_between(front)
    alone = make_gaussians(**{name: getattr(mixture, name)[place] for name in NAMES})
    gradient = Functional(parameters(alone), POSE, CAMERA).image_gradient()
    results = []
    for gaussians in (alone, mixture):
        gaussian_map, rasterizer = GaussianMap.from_gaussians(gaussians), Rasterizer(CAMERA)
        images = rasterizer.forward(gaussian_map, POSE, with_embedding=True)
        into = MapGradient.zeros(gaussian_map.capacity)
        pose = rasterizer.backward(gaussian_map, gradient, into)
        results.append((images.colour.copy(), images.depth.copy(), into, pose))
    (colour, depth, into_alone, pose_alone), (colour_too, depth_too, into_mixture, pose_mixture) = results
    np.testing.assert_array_equal(colour, colour_too)
    np.testing.assert_array_equal(depth, depth_too)
    others = np.setdiff1d(np.arange(len(mixture)), place)
    for name in PARAMETERS:
        np.testing.assert_array_equal(getattr(into_mixture, name)[place], getattr(into_alone, name), err_msg=name)
        assert not getattr(into_mixture, name)[others].any(), name
    np.testing.assert_allclose(pose_mixture, pose_alone, rtol=1e-5)


def test_splats_equal_the_twins() -> None:
    """Columns of the rows themselves, so that no error hides behind the blending."""
    gaussians = random_gaussians(100, CAMERA, seed=29)
    expected = project(parameters(gaussians), POSE, CAMERA)
    gaussian_map, n = GaussianMap.from_gaussians(gaussians), len(gaussians)
    splat, tile_rect = runtime.zeros((n, projection.SPLAT)), runtime.zeros((n, 4), np.int32)
    tile_count = runtime.zeros((n,), np.int32)
    projection.project(
        n, gaussian_map.mean, gaussian_map.log_scale, gaussian_map.quat_wxyz, gaussian_map.opacity_logit,
        gaussian_map.colour, gaussian_map.embedding, runtime.to_device(POSE[:3].reshape(12)),
        runtime.to_device([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy]), CAMERA.width, CAMERA.height, True,
        splat, tile_rect, tile_count,
    )  # fmt: skip
    drawn = tile_count > 0
    assert drawn.sum() > 80
    wanted = {
        projection.U: expected.uv[:, 0], projection.V: expected.uv[:, 1], projection.Z: expected.depth,
        projection.QA: 0.5 * expected.precision[:, 0, 0], projection.QB: expected.precision[:, 0, 1],
        projection.QC: 0.5 * expected.precision[:, 1, 1], projection.FADE: -np.log(expected.opacity),
        projection.ZU: expected.slope[:, 0], projection.ZV: expected.slope[:, 1], projection.INV_Z: 1 / expected.depth,
    }  # fmt: skip
    for column, values in wanted.items():
        scale = np.abs(values[drawn]).max()
        np.testing.assert_allclose(splat[drawn, column], values[drawn], rtol=2e-5, atol=2e-6 * scale, err_msg=column)
    for c in range(3):
        np.testing.assert_array_equal(splat[drawn, projection.RED + c], gaussians.colour[drawn, c])
        np.testing.assert_allclose(splat[drawn, projection.EMBEDDING + c], expected.embedding[drawn, c], rtol=1e-6)
