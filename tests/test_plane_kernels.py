"""Plane kernels and the algebra of moments against float64."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.reference import planes as reference
from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.ops import plane_fit
from tgslam.planes.segmentation.moments import Joints, planes_of, squared_residuals

SIGMA = 0.0015
SIZES = [(24, 32, 8), (31, 17, 8), (13, 45, 5), (3, 2, 4), (1, 1, 8)]


def camera_of(height, width):
    return Camera(width, height, 60.0, 55.0, width / 2 - 0.7, height / 2 + 0.4)


def scene(height, width, seed=0):
    """Depth of three planes that meet, with noise, holes and outliers; and the planes."""
    rng = np.random.default_rng(seed)
    camera = camera_of(height, width)
    planes = np.array([[0.5, 0.004, 0.001], [0.45, -0.004, 0.002], [0.48, 0.0, -0.005]])
    v, u = np.mgrid[:height, :width]
    w = np.max([g[0] + g[1] * (u - camera.cx) + g[2] * (v - camera.cy) for g in planes], axis=0)
    depth_m = 1.0 / (w + SIGMA * rng.normal(size=w.shape))
    depth_m[rng.random(w.shape) < 0.1] *= 1.2
    depth_m[rng.random(w.shape) < 0.15] = 0.0
    return np.float32(depth_m), camera, planes


def cell_labels_of(grid, seed=0):
    return np.random.default_rng(seed).integers(-1, 3, grid.shape).astype(np.int32)


@pytest.mark.parametrize(("height", "width", "cell"), SIZES)
def test_cell_moments(height, width, cell):
    depth_m, camera, _ = scene(height, width)
    grid = plane_fit.CellGrid(camera, cell)
    got, noise = plane_fit.cell_moments(runtime.to_device(depth_m), grid)
    expected = reference.cell_moments(depth_m.astype(float), cell, camera.cx, camera.cy)
    np.testing.assert_allclose(got, expected, rtol=2e-6, atol=1e-4)
    np.testing.assert_allclose(noise, reference.white_noise(depth_m.astype(float), cell), rtol=2e-3, atol=1e-12)


def test_cell_residuals_keep_single_precision_of_the_noise():
    depth_m, camera, _ = scene(48, 64)
    grid = plane_fit.CellGrid(camera, 8)
    got = squared_residuals(plane_fit.cell_moments(runtime.to_device(depth_m), grid)[0])
    expected = squared_residuals(reference.cell_moments(depth_m.astype(float), 8, camera.cx, camera.cy))
    np.testing.assert_allclose(got, expected, rtol=1e-3, atol=1e-3 * SIGMA**2)


@pytest.mark.parametrize(("height", "width", "cell"), SIZES)
@pytest.mark.parametrize("seed", [0, 1])
def test_pixel_labels(height, width, cell, seed):
    depth_m, camera, planes = scene(height, width, seed)
    grid = plane_fit.CellGrid(camera, cell)
    cells, tolerance = cell_labels_of(grid, seed), np.array([4.0, 6.0, 5.0]) * SIGMA
    pixels = plane_fit.PixelLabels(runtime.to_device(depth_m), grid, cells)
    pixels.assign(planes, tolerance)
    raw = reference.label_pixels(depth_m.astype(float), cell, camera.cx, camera.cy, cells, planes, tolerance)
    np.testing.assert_array_equal(pixels.read(), reference.drop_lonely(raw))
    if height > 20:
        assert len(np.unique(pixels.read())) >= 3


@pytest.mark.parametrize(("height", "width", "cell"), SIZES)
def test_segment_sums(height, width, cell):
    depth_m, camera, planes = scene(height, width)
    grid = plane_fit.CellGrid(camera, cell)
    pixels = plane_fit.PixelLabels(runtime.to_device(depth_m), grid, cell_labels_of(grid))
    pixels.assign(planes, np.full(3, 4.0 * SIGMA))
    sums = pixels.sums(planes, SIGMA)
    place = (depth_m.astype(float), cell, camera.cx, camera.cy)
    expected = reference.segment_sums(*place, planes, pixels.read(), SIGMA)
    got = dict(zip(zip(sums.cell.tolist(), sums.plane.tolist(), strict=True), range(len(sums.cell)), strict=True))
    assert got.keys() == expected.keys()
    for key, (moments, count, squares) in expected.items():
        row = got[key]
        assert sums.pixels[row] == count
        np.testing.assert_allclose(sums.squares[row], squares, rtol=1e-3, atol=1e-9)
        np.testing.assert_allclose(sums.moments[row][:6], moments[:6], rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(sums.moments[row][6:], moments[6:], rtol=1e-3, atol=2e-5)


coefficient = st.floats(-0.003, 0.003)


@given(st.floats(0.2, 2.0), coefficient, coefficient, st.integers(0, 1000))
def test_a_plane_without_noise_is_fitted_exactly(g0, gx, gy, seed):
    camera = camera_of(16, 16)
    v, u = np.mgrid[:16, :16]
    depth_m = np.float32(1.0 / (g0 + gx * (u - camera.cx) + gy * (v - camera.cy)))
    depth_m[np.random.default_rng(seed).random((16, 16)) < 0.4] = 0.0
    moments, _ = plane_fit.cell_moments(runtime.to_device(depth_m), plane_fit.CellGrid(camera, 8))
    np.testing.assert_allclose(planes_of(moments), np.tile([g0, gx, gy], (4, 1)), atol=1e-6)
    first, second = np.array([0, 0, 1]), np.array([1, 2, 3])
    assert (Joints.of(moments, first, second).cost < 1e-3 * SIGMA**2).all()


def test_moments_move_like_their_points():
    rng = np.random.default_rng(0)
    x, y, w = rng.normal(size=(3, 50))
    here = np.sum([reference.features(*p) for p in zip(x, y, w, strict=True)], axis=0)
    there = np.sum([reference.features(*p) for p in zip(x + 3.0, y - 2.0, w + 0.5, strict=True)], axis=0)
    moved = plane_fit.moved(here[None], np.array([[3.0, -2.0]]), np.array([0.5]))
    np.testing.assert_allclose(moved[0], there, rtol=1e-12)


def test_fits_and_joining_costs_are_least_squares():
    rng = np.random.default_rng(1)
    points = [rng.normal(size=(n, 3)) * [5.0, 3.0, 0.1] for n in (20, 35)]
    moments = np.array([np.sum([reference.features(*p) for p in set_], axis=0) for set_ in points])

    def solved(p):
        design = np.column_stack([np.ones(len(p)), p[:, :2]])
        plane = np.linalg.lstsq(design, p[:, 2], rcond=None)[0]
        return plane, ((p[:, 2] - design @ plane) ** 2).sum()

    for plane, residual, p in zip(planes_of(moments), squared_residuals(moments), points, strict=True):
        np.testing.assert_allclose(plane, solved(p)[0], rtol=1e-9)
        np.testing.assert_allclose(residual, solved(p)[1], rtol=1e-9)
    cost = Joints.of(moments, np.array([0]), np.array([1])).cost
    expected = solved(np.concatenate(points))[1] - solved(points[0])[1] - solved(points[1])[1]
    np.testing.assert_allclose(cost, expected, rtol=1e-9)


def test_points_on_a_line_have_a_plane_without_slope():
    moments = np.sum([reference.features(x, 2.0 * x, 0.4 + 0.1 * x) for x in range(5)], axis=0)
    np.testing.assert_allclose(planes_of(moments[None]), [[0.6, 0.0, 0.0]])
    np.testing.assert_array_equal(planes_of(np.zeros((1, 10))), np.zeros((1, 3)))


def test_wrong_shapes_are_refused():
    with pytest.raises(ValueError, match="depth_m"):
        plane_fit.cell_moments(np.zeros((5, 5), np.float32), plane_fit.CellGrid(camera_of(4, 4), 2))
