"""Seeding: which cells of a frame become Gaussians, and whether those lie on the surfaces and look like the frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.reference.seeding import cell_measures
from tgslam.camera import Camera, SensorNoise
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.map_settings import SeedingConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.device import runtime
from tgslam.evaluation.image_metrics import masked_psnr
from tgslam.geometry import inverse, matrix_from_quat_wxyz, se3_exp, transform_points
from tgslam.kernels import seeding as kernels
from tgslam.mapping.insertion import seed
from tgslam.mapping.quadtree import Cells, Quadtree, cell_levels
from tgslam.ops.normals import normals_of
from tgslam.ops.rasterize import Rasterizer
from tgslam.types import Frame, Gaussians

SIGMA = 0.0015  # 1/m
NOISE = SensorNoise(SIGMA)
CAMERA = Camera(96, 72, 80.0, 80.0, 47.5, 35.5)
LARGEST = 8  # px
CONFIG = SeedingConfig(largest_cells_across=CAMERA.width // LARGEST)


def leaves(colour, depth_m, wanted, config, noise, ids=None) -> Cells:
    return Quadtree(colour, depth_m, config, noise, ids).leaves(wanted)


def everywhere(depth_m: NDArray) -> NDArray[np.bool_]:
    return np.ones(depth_m.shape, bool)


def plane_depth(tilt_rad: float, camera: Camera = CAMERA, distance_m: float = 2.0) -> NDArray[np.float64]:
    """Depth of a plane ahead, turned by `tilt_rad` about the image's y axis."""
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    row = distance_m * np.cos(tilt_rad) / (x * np.sin(tilt_rad) + np.cos(tilt_rad))
    return np.tile(row, (camera.height, 1))


def plane_normal(tilt_rad: float) -> NDArray[np.float64]:
    """The normal of `plane_depth`, towards the camera."""
    return np.array([-np.sin(tilt_rad), 0.0, -np.cos(tilt_rad)])


def grey(depth_m: NDArray) -> NDArray[np.float64]:
    return np.full((*depth_m.shape, 3), 0.5)


def squares(cells: Cells) -> list[tuple[slice, slice]]:
    """The pixels of each cell. Its centre is a mean of pixels inside it, which tells where the square begins."""
    size = cells.size_px.astype(int)
    left, top = (cells.u // size).astype(int) * size, (cells.v // size).astype(int) * size
    return [(slice(y, y + s), slice(x, x + s)) for x, y, s in zip(left, top, size, strict=True)]


def times_covered(cells: Cells, shape: tuple[int, int]) -> NDArray[np.int_]:
    count = np.zeros(shape, int)
    for square in squares(cells):
        count[square] += 1
    return count


@st.composite
def patchy_frames(draw: st.DrawFn) -> tuple[NDArray, NDArray, NDArray]:
    """Colour, depth and wanted mask with plain areas, texture, steps and holes, of any size."""
    height, width = draw(st.integers(3, 29)), draw(st.integers(3, 29))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def patches(values: list[float]) -> NDArray:
        coarse = rng.choice(values, (-(-height // 6), -(-width // 6)))
        return np.repeat(np.repeat(coarse, 6, 0), 6, 1)[:height, :width]

    depth_m = patches([1.0, 2.0, 2.0, 2.0])
    depth_m[rng.random(depth_m.shape) < draw(st.sampled_from([0.0, 0.02, 0.5, 1.0]))] = 0.0
    texture = patches([0.0, 0.0, 0.3])[..., None] * rng.random((height, width, 3))
    wanted = patches([0.0, 1.0]) + (rng.random(depth_m.shape) < draw(st.sampled_from([0.0, 0.3]))) > 0
    return 0.5 + texture, depth_m, wanted


@pytest.mark.parametrize("on_planes_only", [False, True])
@pytest.mark.parametrize("shape", [(24, 32), (37, 51), (5, 3)])
@pytest.mark.parametrize("size", [1, 2, 4, 8])
def test_plain_and_planar_cells_match_the_twin(shape: tuple[int, int], size: int, on_planes_only: bool) -> None:
    rng = np.random.default_rng(size)
    v, u = np.mgrid[: shape[0], : shape[1]]
    rough = np.where(u + v < 0.4 * sum(shape), 0.0, rng.random(shape))
    depth_m = 1.0 / (0.5 + 0.002 * u - 0.003 * v + 0.003 * rough * rng.normal(size=shape) + 0.1 * (u > 30))
    depth_m[rng.random(shape) < 0.02] = 0.0
    colour = 0.5 + 0.03 * (rough * rng.random(shape))[..., None] * rng.normal(size=(*shape, 3))
    colour += (0.002 * (u - v))[..., None] * (u > 16)[..., None]
    ids = np.where(u > 16, np.where(v > 12, 5, 2), -1).astype(np.int32)
    depth_m, colour = (image.astype(np.float32) for image in (depth_m, colour))
    cells = cell_measures(colour.astype(float), depth_m.astype(float), ids, size)
    actual = runtime.empty(cells.complete.shape, np.int32)
    on_device = runtime.to_device(colour), runtime.to_device(depth_m), runtime.to_device(ids, np.int32)
    kernels.plain_and_planar(*on_device, size, 0.01, 0.006, 0.001, on_planes_only, actual)
    spread = np.where(cells.on_plane, cells.detrended, cells.spread)
    limit = np.where(cells.on_plane, 0.006, 0.01)
    clear = (abs(spread - limit) > 1e-6) & (abs(cells.residual - 0.001) > 3e-7)  # not at a threshold
    assert clear.mean() > 0.99
    good = cells.complete & (spread < limit) & (cells.residual < 0.001) & (cells.on_plane | (not on_planes_only))
    expected = np.where(good, np.where(cells.on_plane, kernels.ON_PLANE, kernels.PLAIN_AND_PLANAR), 0)
    np.testing.assert_array_equal(runtime.to_host(actual)[clear], expected[clear])
    if shape[0] > 30 and size in (2, 4):
        assert 0 < good.sum() < cells.complete.sum() < cells.complete.size
        assert kernels.ON_PLANE in expected


def test_cells_on_a_plane_grow_larger_and_ignore_a_trend_and_small_gaps() -> None:
    v, u = np.mgrid[:64, :128]
    depth_m = np.full(v.shape, 2.0, np.float32)
    colour = np.repeat((0.2 + 0.004 * u)[..., None], 3, -1).astype(np.float32)
    ids = np.where(u < 64, 3, -1).astype(np.int32)
    config = SeedingConfig(smallest_cell_px=2, largest_cells_across=16, largest_plane_cells_across=4)
    sizes = Quadtree(colour, depth_m, config, NOISE, ids).sizes(depth_m > 0)
    assert (sizes[:, :16] == 32).all()  # the plane, whose colour is plain but for its trend
    assert (sizes[:, 16:32] == 16).all()  # a large cell has no small ones beside it
    assert (sizes[:, 32:] < 16).all()  # elsewhere as without planes
    wanted = np.zeros(v.shape, bool)
    wanted[:32, :20], wanted[40:42, 10:12] = True, True  # most of a large cell; a crumb
    cells = leaves(colour, depth_m, wanted, config, NOISE, ids)
    assert cells.size_px.tolist() == [32.0]
    without = leaves(colour, depth_m, wanted, config, NOISE)
    assert without.size_px.max() <= 8 and len(without.u) > 10


def test_cells_where_depth_is_a_guess_count_as_small() -> None:
    depth_m = np.full((64, 64), 2.0, np.float32)
    sound = np.ones(depth_m.shape, bool)
    sound[:, 40:44] = False
    config = SeedingConfig(smallest_cell_px=2, largest_cells_across=8)
    sizes = Quadtree(grey(depth_m), depth_m, config, NOISE).sizes(sound)
    assert (sizes[:, 20:22] == 2).all() and (sizes[:, 22:24] == 4).all()
    assert (sizes[:, :20] == 8).all() and (sizes[:, 24:] == 8).all()


@pytest.mark.parametrize(("width_px", "plain_px", "plane_px"), [(64, 2, 2), (320, 4, 8), (640, 8, 16), (1200, 16, 32)])
def test_the_largest_cells_cover_the_same_angle_in_images_of_every_size(width_px, plain_px, plane_px) -> None:
    config = SeedingConfig(smallest_cell_px=2, largest_cells_across=80, largest_plane_cells_across=40)
    assert 2 ** cell_levels(config, width_px) == plain_px
    assert 2 ** cell_levels(config, width_px, on_planes=True) == plane_px


def test_large_cells_on_a_plane_keep_away_from_its_edges_and_texture() -> None:
    depth_m = np.full((128, 128), 2.0, np.float32)
    colour = np.full((128, 128, 3), 0.5, np.float32)
    colour[60:62, 60:62] = 0.9
    ids = np.zeros(depth_m.shape, np.int32)
    ids[:, 96:] = -1
    config = SeedingConfig(
        smallest_cell_px=2, largest_cells_across=32, largest_plane_cells_across=8
    )  # up to 4 and 16 px
    sizes = np.repeat(np.repeat(Quadtree(colour, depth_m, config, NOISE, ids).sizes(depth_m > 0), 2, 0), 2, 1)
    for y, x in np.argwhere(sizes == 16)[::7]:
        y, x = y // 16 * 16, x // 16 * 16
        around = sizes[max(y - 8, 0) : y + 24, max(x - 8, 0) : x + 24]
        assert around.min() >= 8
    assert (sizes[:32, :64] == 16).all() and (sizes[60:62, 60:62] == 2).all()
    assert (sizes[:, 84:96] <= 8).all() and (sizes[:, 96:] == 4).all()


def test_gaussians_on_a_plane_know_it() -> None:
    depth_m = np.full((32, 32), 2.0, np.float32)
    ids = np.where(np.mgrid[:32, :32][1] < 16, 3, -1).astype(np.int32)
    camera = Camera(32, 32, 30.0, 30.0, 15.5, 15.5)
    cells = leaves(grey(depth_m), depth_m, everywhere(depth_m), CONFIG, NOISE, ids)
    normals = np.zeros((32, 32, 3), np.float32)
    new = seed(cells, normals, camera, np.eye(4), 0, CONFIG, ids)
    assert set(new.plane_id[cells.u < 15]) == {3}
    assert set(new.plane_id[cells.u > 17]) == {-1}


@settings(max_examples=150)
@given(patchy_frames(), st.integers(1, 3), st.integers(1, 4))
def test_every_pixel_with_depth_is_covered_once(frame: tuple, smallest: int, levels: int) -> None:
    colour, depth_m, _ = frame
    across = max(round(depth_m.shape[1] / (smallest << (levels - 1))), 1)
    config = SeedingConfig(smallest_cell_px=smallest, largest_cells_across=across)
    cells = leaves(colour, depth_m, everywhere(depth_m), config, NOISE)
    count = times_covered(cells, depth_m.shape)
    assert (count[depth_m > 0] == 1).all()
    assert count.max(initial=0) <= 1
    assert all((depth_m[square] > 0).any() for square in squares(cells))


@settings(max_examples=150)
@given(patchy_frames())
def test_the_smallest_cells_that_are_wanted_by_half_are_covered_and_no_others(frame: tuple) -> None:
    colour, depth_m, wanted = frame
    count = times_covered(leaves(colour, depth_m, wanted, CONFIG, NOISE), depth_m.shape)
    size = CONFIG.smallest_cell_px
    for y in range(0, depth_m.shape[0], size):
        for x in range(0, depth_m.shape[1], size):
            cell = (slice(y, y + size), slice(x, x + size))
            valid = depth_m[cell] > 0
            if valid.any():
                assert (count[cell] == (2 * (wanted[cell] & valid).sum() >= valid.sum())).all()


@pytest.mark.parametrize("nearer_columns", [11, 12])
def test_no_cell_hangs_between_two_surfaces(nearer_columns: int) -> None:
    """Whether the edge runs between cells or through them: of a cell that shows both surfaces one is taken."""
    depth_m = np.where(np.arange(CAMERA.width) < nearer_columns, 1.0, 3.0) * np.ones((CAMERA.height, 1))
    colour = np.where(depth_m[..., None] < 2.0, 0.2, 0.8) * np.ones(3)
    cells = leaves(colour, depth_m, everywhere(depth_m), CONFIG, NOISE)
    np.testing.assert_allclose(np.minimum(abs(cells.depth_m - 1.0), abs(cells.depth_m - 3.0)), 0.0, atol=1e-6)
    np.testing.assert_allclose(cells.colour[:, 0], np.where(cells.depth_m < 2.0, 0.2, 0.8), atol=1e-6)
    assert (times_covered(cells, depth_m.shape) == 1).all()


def test_a_cell_shows_what_most_of_its_pixels_show() -> None:
    """Three of four on the farther surface, then all but one without depth, then a slope that is no step."""
    depth_m = np.full((CAMERA.height, CAMERA.width), 2.0)
    depth_m[0, :4] = [1.0, 2.0, 2.0, 2.0]
    depth_m[0:2, 4:6] = [[0.0, 0.0], [0.0, 1.5]]
    depth_m[0:2, 8:10] = [[2.0, 2.02], [2.0, 2.02]]
    rng = np.random.default_rng(3)
    colour = rng.random((*depth_m.shape, 3))  # the smallest cells everywhere
    cells = leaves(colour, depth_m, everywhere(depth_m), CONFIG, NOISE)
    at = {(int(u) // 2, int(v) // 2): i for i, (u, v) in enumerate(zip(cells.u, cells.v, strict=True))}
    np.testing.assert_allclose(
        cells.depth_m[[at[0, 0], at[2, 0], at[4, 0]]], [2.0, 1.5, 2.0 / (1.0 - 0.005 / 1.01)], rtol=1e-4
    )
    np.testing.assert_allclose(cells.colour[at[0, 0]], colour[[0, 1, 1], [1, 0, 1]].mean(0))


def test_nothing_wanted_or_no_depth_gives_no_cell() -> None:
    depth_m = plane_depth(0.0)
    assert len(leaves(grey(depth_m), depth_m, ~everywhere(depth_m), CONFIG, NOISE).u) == 0
    empty = leaves(grey(depth_m), 0 * depth_m, everywhere(depth_m), CONFIG, NOISE)
    normals = np.zeros((*depth_m.shape, 3))
    assert len(empty.u) == len(seed(empty, normals, CAMERA, np.eye(4), 0, CONFIG)) == 0


@pytest.mark.parametrize("tilt_rad", [0.0, 0.5, 0.9])
def test_a_plain_plane_gives_the_largest_cells(tilt_rad: float) -> None:
    depth_m = plane_depth(tilt_rad)
    cells = leaves(grey(depth_m), depth_m, everywhere(depth_m), CONFIG, NOISE)
    assert (cells.size_px == LARGEST).all()
    # The mean of inverse depths is the plane's depth at the centre, which lies between pixels
    x = (cells.u - CAMERA.cx) / CAMERA.fx
    exact_m = 2.0 * np.cos(tilt_rad) / (x * np.sin(tilt_rad) + np.cos(tilt_rad))
    np.testing.assert_allclose(cells.depth_m, exact_m, rtol=1e-9)


def test_the_sensors_noise_does_not_break_a_plane_up_and_twice_the_limit_does() -> None:
    depth_m, rng = plane_depth(0.4), np.random.default_rng(0)
    noise_m = SIGMA * depth_m**2 * rng.standard_normal(depth_m.shape)
    noisy = leaves(grey(depth_m), depth_m + noise_m, everywhere(depth_m), CONFIG, NOISE)
    assert (noisy.size_px == LARGEST).mean() > 0.99
    rough = depth_m + 2 * CONFIG.expert.flatness.planar_sigmas * noise_m
    assert (leaves(grey(depth_m), rough, everywhere(depth_m), CONFIG, NOISE).size_px < LARGEST).mean() > 0.99


@pytest.mark.parametrize("what", ["texture", "step", "hole"])
def test_cells_are_small_at_texture_steps_and_holes_and_large_elsewhere(what: str) -> None:
    depth_m = plane_depth(0.0)
    colour = grey(depth_m)
    busy = np.zeros(depth_m.shape, bool)
    if what == "texture":
        busy[20:31, 30:50] = True
        colour[busy] += 0.2 * ((np.indices(depth_m.shape).sum(0) % 2)[busy])[:, None]
    elif what == "step":
        depth_m[:, 43:] = 1.5
        busy[:, 42:44] = True
    else:
        depth_m[30:33, 40:45] = 0.0
        busy[29:34, 39:46] = True
    cells = leaves(colour, depth_m, everywhere(depth_m), CONFIG, NOISE)
    for square, size in zip(squares(cells), cells.size_px, strict=True):
        if size > CONFIG.smallest_cell_px:
            assert (depth_m[square] > 0).all()
            assert np.ptp(depth_m[square]) == 0
            assert np.ptp(colour[square]) == 0
        top, left = (axis.start // LARGEST * LARGEST for axis in square)
        if not busy[top : top + LARGEST, left : left + LARGEST].any():
            assert size == LARGEST


@pytest.mark.parametrize("tilt_deg", [0, 30, 60, 72])
def test_a_gaussian_is_as_wide_as_its_cell_in_the_image(tilt_deg: int) -> None:
    tilt_rad = np.deg2rad(tilt_deg)
    new, cells = seeded_plane(tilt_rad)
    spread_px = np.sqrt(np.linalg.eigvalsh(projected_covariance(new, CAMERA)))
    relative = spread_px / (CONFIG.expert.gaussians.overlap * cells.size_px[:, None])
    towards = -new.mean / np.linalg.norm(new.mean, axis=1, keepdims=True)
    not_grazing = towards @ plane_normal(tilt_rad) > 0.26
    assert not_grazing.sum() > 40
    assert relative[not_grazing].min() > 0.8
    assert relative[not_grazing].max() < 1.3
    near_centre = np.hypot(cells.u - CAMERA.cx, cells.v - CAMERA.cy) < 12
    np.testing.assert_allclose(relative[near_centre], 1.0, atol=0.12)


def test_a_surface_seen_at_grazing_angle_gives_no_needles() -> None:
    new, _ = seeded_plane(np.deg2rad(84.0))
    width = np.exp(new.log_scale[:, :2])
    assert (width.max(1) / width.min(1) < 4.01).all()
    assert (width.max(1) / width.min(1)).max() > 3.9


def seeded_plane(tilt_rad: float) -> tuple[Gaussians, Cells]:
    depth_m = plane_depth(tilt_rad)
    cells = leaves(grey(depth_m), depth_m, everywhere(depth_m) & (depth_m > 0) & (depth_m < 9), CONFIG, NOISE)
    normals = np.tile(plane_normal(tilt_rad), (*depth_m.shape, 1))
    return seed(cells, normals, CAMERA, np.eye(4), 0, CONFIG), cells


def projected_covariance(gaussians: Gaussians, camera: Camera) -> NDArray[np.float64]:
    """[N, 2, 2] px^2, by the projection's derivative at each centre; the camera is the world frame."""
    R = matrix_from_quat_wxyz(gaussians.quat_wxyz)
    S = np.exp(gaussians.log_scale.astype(np.float64))[:, :, None] * np.swapaxes(R, 1, 2)
    x, y, z = gaussians.mean.astype(np.float64).T
    J = np.zeros((len(gaussians), 2, 3))
    J[:, 0, 0], J[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
    J[:, 1, 1], J[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
    half = J @ np.swapaxes(S, 1, 2)
    return half @ np.swapaxes(half, 1, 2)


def test_without_a_normal_gaussians_face_the_camera() -> None:
    depth_m = plane_depth(0.0)
    cells = leaves(grey(depth_m), depth_m, everywhere(depth_m), CONFIG, NOISE)
    new = seed(cells, np.zeros((*depth_m.shape, 3)), CAMERA, np.eye(4), 0, CONFIG)
    thin = matrix_from_quat_wxyz(new.quat_wxyz)[:, :, 2]
    towards = -new.mean / np.linalg.norm(new.mean, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((thin * towards).sum(1)), 1.0, atol=1e-5)


@pytest.fixture(scope="module")
def source() -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(scene="room", width=161, height=118, frames=720), seed=0)


def seeded_frame(source: SyntheticSource, frame: Frame, T_cw: NDArray) -> tuple[Gaussians, Cells]:
    cells = leaves(frame.colour, frame.depth_m, everywhere(frame.depth_m), CONFIG, NOISE)
    normals = normals_of(frame.depth_m, source.camera, NOISE)
    return seed(cells, normals, source.camera, T_cw, 7, CONFIG), cells


@pytest.mark.parametrize("index", [0, 300])
def test_gaussians_lie_flat_on_the_true_surfaces(source: SyntheticSource, index: int) -> None:
    T_cw = inverse(source.pose(index))
    new, cells = seeded_frame(source, source.clean(index), T_cw)
    label = source.labels(index)
    # Cells that see one plane only, and so do the 14x14 pixels that their normals come from
    labels = [label[max(y.start - 8, 0) : y.stop + 8, max(x.start - 8, 0) : x.stop + 8] for y, x in squares(cells)]
    inside = np.array([np.ptp(around) == 0 and around.min() >= 0 for around in labels])
    assert inside.sum() > 1000
    plane = source.planes()[[around.flat[0] for around in labels]][inside]
    distance_m = (plane[:, :3] * new.mean[inside]).sum(1) + plane[:, 3]
    assert np.abs(distance_m).max() < 1e-5
    thin = matrix_from_quat_wxyz(new.quat_wxyz[inside])[:, :, 2]
    assert np.abs((thin * plane[:, :3]).sum(1)).min() > np.cos(np.deg2rad(0.05))
    scale = np.exp(new.log_scale)
    np.testing.assert_allclose(scale[:, 2], CONFIG.expert.gaussians.thickness * scale[:, :2].min(1), rtol=1e-4)
    assert (new.birth_keyframe == 7).all()


@pytest.mark.parametrize(("index", "noise"), [(0, False), (0, True), (300, True)])
def test_a_seeded_frame_looks_like_the_frame(source: SyntheticSource, index: int, noise: bool) -> None:
    frame = source.read(index) if noise else source.clean(index)
    T_cw = se3_exp([0.2, -0.4, 0.1, 1.0, 2.0, -0.5])  # the world frame is of no concern
    new, _ = seeded_frame(source, frame, T_cw)
    rendering = Rasterizer(source.camera).render(new, T_cw)
    measured = frame.depth_m > 0
    assert (rendering.opacity[measured] > 0.9).mean() > 0.96
    assert rendering.opacity[measured].min() > 0.6
    assert masked_psnr(rendering.colour, frame.colour, measured) > 25.0
    both = measured & (rendering.depth_m > 0)
    exact_m = source.clean(index).depth_m
    error_sigmas = np.abs(rendering.depth_m - exact_m)[both] / (SIGMA * exact_m[both] ** 2)
    assert np.median(error_sigmas) < 0.8


def test_means_are_in_the_world_frame() -> None:
    depth_m = plane_depth(0.0)
    cells = leaves(grey(depth_m), depth_m, everywhere(depth_m), CONFIG, NOISE)
    normals = np.tile(plane_normal(0.0), (*depth_m.shape, 1))
    T_cw = se3_exp([0.3, -0.2, 0.5, 0.4, -1.0, 2.0])
    here, there = (seed(cells, normals, CAMERA, T, 0, CONFIG) for T in (np.eye(4), T_cw))
    np.testing.assert_allclose(transform_points(T_cw, there.mean), here.mean, atol=1e-5)
    thin = T_cw[:3, :3] @ matrix_from_quat_wxyz(there.quat_wxyz)[:, :, 2:]
    np.testing.assert_allclose(np.abs(thin[:, 2, 0]), 1.0, atol=1e-5)
