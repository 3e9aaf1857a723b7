"""Planes of single views, in scenes whose planes are known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tgslam.camera import Camera, SensorNoise
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.plane_settings import PlanesConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.device import runtime
from tgslam.geometry import tangent_axes
from tgslam.ops.plane_fit import CellGrid
from tgslam.planes.segment import PlaneView
from tgslam.planes.segmentation import merging
from tgslam.planes.segmentation.cells import planar_cells
from tgslam.planes.segmentation.extraction import extract_planes

SIGMA = 0.0015
CAMERA = Camera(320, 240, 280.0, 275.0, 158.0, 121.0)
CONFIG = PlanesConfig()
LIMITS = CONFIG.expert.segmentation
WALL = (0.0, 0.0, -1.0)


def plane_depth(normal, offset_m: float, camera: Camera = CAMERA) -> np.ndarray:
    """[H, W] depth of n . x + d = 0; infinite where a ray does not meet it."""
    along = -camera.rays() @ (np.asarray(normal) / np.linalg.norm(normal))
    return np.where(along > 1e-6, offset_m / np.maximum(along, 1e-6), np.inf)


def seen(
    exact_m: np.ndarray, seed: int | None = 0, camera: Camera = CAMERA, config: PlanesConfig = CONFIG
) -> PlaneView:
    """What is extracted from an exact depth image, with the sensor's noise added; seed None: without."""
    noise = 0.0 if seed is None else SIGMA * np.random.default_rng(seed).normal(size=exact_m.shape)
    depth_m = np.where(np.isfinite(exact_m) & (exact_m > 0), 1.0 / (1.0 / np.maximum(exact_m, 1e-6) + noise), 0.0)
    return extract_planes(
        runtime.to_device(np.ascontiguousarray(depth_m, np.float32)), camera, config, SensorNoise(SIGMA)
    )


def deviation(segment, normal, offset_m) -> np.ndarray:
    """[3] true plane minus segment, in the coordinates of its covariance."""
    first, second = tangent_axes(segment.normal_c)
    return np.array([-second @ normal, first @ normal, -(normal @ segment.centroid_c + offset_m)])


def assert_true(segment, normal, offset_m, max_deg=0.3, max_m=0.003) -> None:
    normal = np.asarray(normal) / np.linalg.norm(normal)
    assert np.degrees(np.arccos(np.clip(segment.normal_c @ normal, -1, 1))) < max_deg
    assert abs(normal @ segment.centroid_c + offset_m) < max_m


@pytest.mark.parametrize("seed", [None, 0])
def test_one_plane_fills_the_view(seed):
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    view = seen(plane_depth(normal, 1.8), seed)
    assert len(view.segments) == 1
    segment = view.segments[0]
    assert segment.reliable and segment.area_px == (view.labels == 0).sum() > 0.98 * view.labels.size
    assert_true(segment, normal, 1.8, 0.05, 0.001)
    assert abs(np.linalg.norm(segment.normal_c) - 1) < 1e-9 and segment.offset_m > 0
    assert abs(segment.normal_c @ segment.centroid_c + segment.offset_m) < 1e-9
    assert segment.rms_sigmas < 1.1 and (seed is None or segment.rms_sigmas > 0.9)
    assert segment.rms_m == pytest.approx(segment.rms_sigmas * SIGMA * segment.centroid_c[2] ** 2, rel=0.3, abs=1e-6)


def test_the_area_of_a_wall_is_that_of_its_visible_part():
    exact_m = plane_depth(WALL, 2.0)
    view = seen(exact_m)
    assert view.segments[0].area_m2 == pytest.approx(320 / 280 * 240 / 275 * 4.0, rel=0.02)


@settings(max_examples=40)
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.7, 4.0))
def test_any_plane_is_found_exactly_without_noise(x, y, offset_m):
    normal = np.array([x, y, -1.0]) / np.linalg.norm([x, y, -1.0])
    exact_m = plane_depth(normal, offset_m)
    assume(np.isfinite(exact_m).all() and exact_m.max() < 15)
    view = seen(exact_m, None)
    assert len(view.segments) == 1 and view.segments[0].area_px == exact_m.size
    assert_true(view.segments[0], normal, offset_m, 0.002, 2e-5)


def test_without_noise_a_plane_joins_in_a_few_rounds(monkeypatch):
    """All costs are zero there: each node has several partners that are as cheap."""
    rounds, partners = [], merging._partners
    monkeypatch.setattr(merging, "_partners", lambda *args: rounds.append(0) or partners(*args))
    view = seen(plane_depth(WALL, 2.0), None)
    assert len(view.segments) == 1
    assert len(rounds) < 60


@given(st.integers(2, 40), st.integers(0, 2**32 - 1))
def test_of_equally_cheap_partners_none_is_taken_twice(nodes, seed):
    rng = np.random.default_rng(seed)
    low, high = np.triu_indices(nodes, 1)
    chosen = rng.random(len(low)) < 4.0 / nodes
    low, high = low[chosen], high[chosen]
    kept = merging._matching(low, high, nodes)
    assert kept.any() or not len(low)
    if not kept.all():
        ends = np.concatenate([low[kept], high[kept]])
        assert len(np.unique(ends)) == len(ends)


def test_errors_are_as_large_as_the_covariance_says():
    normal = np.array([0.4, 0.1, -1.0]) / np.linalg.norm([0.4, 0.1, -1.0])
    squared = []
    for seed in range(20):
        segment = seen(plane_depth(normal, 2.2), seed).segments[0]
        error = deviation(segment, normal, 2.2)
        squared.append(error @ np.linalg.solve(segment.covariance, error))
    assert 1.0 < np.mean(squared) < 5.0  # chi-square of 3 degrees of freedom


@pytest.mark.parametrize("convex", [True, False])
def test_two_planes_that_meet_at_20_degrees(convex):
    lean = np.tan(np.radians(10)) * (1 if convex else -1)
    normals = [np.array([x, 0.0, -1.0]) / np.hypot(x, 1.0) for x in (lean, -lean)]
    depths = [plane_depth(normal, 1.8) for normal in normals]
    view = seen((np.minimum if convex else np.maximum)(*depths))
    assert len(view.segments) == 2
    owner = [int(np.argmax([normal @ s.normal_c for normal in normals])) for s in view.segments]
    assert sorted(owner) == [0, 1]
    for segment, side in zip(view.segments, owner, strict=True):
        assert segment.reliable
        assert_true(segment, normals[side], 1.8)
    nearer = np.argmin(depths, axis=0)
    truth = nearer if convex else 1 - nearer
    assert (np.array([*owner, -1])[view.labels] == truth)[view.labels >= 0].mean() > 0.98


def test_a_step_between_parallel_planes():
    exact_m = plane_depth(WALL, 2.0)
    exact_m[:, 160:] = 2.05
    view = seen(exact_m)
    assert len(view.segments) == 2
    assert sorted(round(s.offset_m, 2) for s in view.segments) == [2.0, 2.05]
    assert (view.labels[:, :158] == view.labels[120, 80]).mean() > 0.98
    assert (view.labels[:, 162:] == view.labels[120, 240]).mean() > 0.98


def tables() -> tuple[np.ndarray, np.ndarray]:
    """Two table tops at one height, 0.2 m apart, over a floor; and a mask of the tops."""
    up = np.array([0.0, -1.0, -1.0]) / np.sqrt(2)
    top, floor = plane_depth(up, 1.2), plane_depth(up, 1.9)
    across = CAMERA.rays()[..., 0] * top
    on_top = (abs(across) > 0.1) & (abs(across) < 0.9) & (np.arange(240)[:, None] > 40)
    return np.where(on_top, top, floor), on_top


def test_coplanar_tables_with_the_floor_between_stay_apart():
    exact_m, on_top = tables()
    view = seen(exact_m)
    left, right = view.labels[150, 90], view.labels[150, 230]
    assert left >= 0 and right >= 0 and left != right
    for label in (left, right):
        assert view.segments[label].offset_m == pytest.approx(1.2, abs=0.005)
        assert on_top[view.labels == label].mean() > 0.98


def test_the_floor_that_tables_part_is_one():
    exact_m, _ = tables()
    exact_m[:40] = plane_depth(np.array([0.0, -1.0, -1.0]), 1.9)[:40]
    floor = [s for s in seen(exact_m).segments if abs(s.offset_m - 1.9) < 0.02]
    assert len(floor) == 1


@pytest.mark.parametrize("missing_px", [0, 5])
def test_a_wall_behind_a_pillar_is_one(missing_px):
    exact_m = plane_depth(WALL, 2.5)
    exact_m[:, 150 - missing_px : 150] = 0.0  # the sensor's shadow
    exact_m[:, 150:185] = 1.4
    view = seen(exact_m)
    assert view.labels[120, 60] == view.labels[120, 260] == 0
    assert view.segments[0].area_px > 0.97 * (exact_m == 2.5).sum()
    assert_true(view.segments[0], WALL, 2.5, 0.05, 0.002)


@pytest.mark.parametrize("step_m", [0.1, 0.2])
def test_a_cell_across_an_oblique_step_is_not_plane(step_m):
    """Its 2 x 2 pixels differ as if it were noise, but those of its neighbours do not."""
    v, u = np.mgrid[:240, :320]
    near = v - 120 > 0.4 * (u - 160)
    noise = SIGMA * np.random.default_rng(0).normal(size=near.shape)
    depth_m = 1.0 / (1.0 / np.where(near, 3.0 - step_m, 3.0) + noise)
    grid = CellGrid.across(CAMERA, CONFIG.expert.segmentation.segmentation_cells_across)
    graph = planar_cells(runtime.to_device(np.float32(depth_m)), grid, SIGMA, LIMITS.cell_share, LIMITS.cell_sigmas)
    rows, columns = grid.shape
    share = near.reshape(rows, grid.cell_px, columns, grid.cell_px).mean(axis=(1, 3)).ravel()
    across = (share > 0.25) & (share < 0.75)
    assert across.sum() > 40 and not across[graph.cell].any()
    assert len(graph.cell) > 0.95 * len(grid)


def test_a_wall_with_an_opening_from_top_to_bottom_is_two():
    exact_m = plane_depth(WALL, 2.0)
    exact_m[:, 140:190] = 3.5
    view = seen(exact_m)
    assert sorted(round(s.offset_m, 1) for s in view.segments) == [2.0, 2.0, 3.5]


def fronts(between_m: float, rows: slice) -> np.ndarray:
    """Two fronts of 0.7 x 0.3 m, one above the other and 2 m away, 3.5 m before a wall; and what parts them."""
    exact_m = plane_depth(WALL, 3.5)
    exact_m[70:112, 110:210] = exact_m[122:164, 110:210] = 2.0
    exact_m[rows, 100:220] = between_m
    return exact_m


def test_rows_of_books_on_two_boards_are_two():
    """A board fills the gap between them, close before their plane; it might as well hide one surface."""
    view = seen(fronts(1.92, slice(112, 122)))
    upper, lower = view.labels[90, 160], view.labels[140, 160]
    assert upper >= 0 and lower >= 0 and upper != lower


def test_rows_of_books_with_a_view_over_them_are_two():
    view = seen(fronts(1.2, slice(116, 122)))
    upper, lower = view.labels[90, 160], view.labels[140, 160]
    assert upper >= 0 and lower >= 0 and upper != lower


def test_a_front_that_a_rail_far_before_it_hides_a_part_of_is_one():
    view = seen(fronts(1.2, slice(112, 122)))
    assert view.labels[90, 160] == view.labels[140, 160] >= 0


def test_a_wall_that_a_board_hides_a_part_of_is_one():
    exact_m = plane_depth(WALL, 2.5)
    exact_m[100:112] = 2.42
    view = seen(exact_m)
    assert view.labels[40, 160] == view.labels[180, 160] == 0


@pytest.mark.parametrize("radius_m", [0.15, 0.4, 0.8, 1.5])
def test_a_cylinder_is_no_plane(radius_m):
    """Its axis is upright, and its front 1.2 m from the camera."""
    r = CAMERA.rays()
    a, b, c = r[..., 0] ** 2 + 1.0, -(1.2 + radius_m), (1.2 + radius_m) ** 2 - radius_m**2
    inside = b * b - a * c
    exact_m = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0.0))) / a, 0.0)
    assert not any(s.reliable for s in seen(exact_m).segments)


def test_a_sphere_is_no_plane():
    r = CAMERA.rays()
    a, b, c = (r**2).sum(axis=-1), -1.7, 1.7**2 - 0.5**2
    inside = b * b - a * c
    exact_m = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0.0))) / a, 0.0)
    assert not any(s.reliable for s in seen(exact_m).segments)


def test_noise_is_no_plane():
    exact_m = np.random.default_rng(0).uniform(1.0, 3.0, (240, 320))
    view = seen(exact_m)
    assert view.segments == () and (view.labels == -1).all()


def test_small_and_thin_segments_wait_for_other_views():
    exact_m = plane_depth(WALL, 3.0)
    exact_m[100:124, 100:124] = 1.5
    exact_m[:, 200:212] = 2.0  # three cells
    view = seen(exact_m)
    assert [s.reliable for s in view.segments] == [True, False, False]
    assert view.segments[0].offset_m == pytest.approx(3.0, abs=0.01)


def test_the_largest_ones_are_kept():
    exact_m = plane_depth(WALL, 4.0)
    for k in range(6):
        exact_m[20:220, 50 * k + 10 : 50 * k + 40 - 2 * k] = 1.5 + 0.3 * k
    every = seen(exact_m, config=replace(CONFIG, max_segments=100)).segments
    kept = seen(exact_m, config=replace(CONFIG, max_segments=3))
    assert len(every) > 4 and len(kept.segments) == 3
    assert [s.area_px for s in kept.segments] == [s.area_px for s in every[:3]]
    assert set(np.unique(kept.labels)) == {-1, 0, 1, 2}


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (3, 5), (8, 8), (9, 17), (30, 33)])
def test_tiny_images(size):
    camera = Camera(size[1], size[0], 30.0, 30.0, size[1] / 2, size[0] / 2)
    view = seen(plane_depth(WALL, 1.0, camera), 0, camera)
    assert view.labels.shape == size and view.labels.dtype == np.int32
    assert len(view.segments) == (min(size) >= 8)  # two cells a side


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_without_measurements_there_is_nothing(value):
    depth_m = np.full((240, 320), value, np.float32)
    view = extract_planes(runtime.to_device(depth_m), CAMERA, CONFIG, SensorNoise(SIGMA))
    assert view.segments == () and (view.labels == -1).all()


def test_a_wrong_size_is_refused():
    with pytest.raises(ValueError, match="depth_m"):
        extract_planes(np.ones((10, 10), np.float32), CAMERA, CONFIG, SensorNoise(SIGMA))


@pytest.fixture(scope="module")
def sources() -> dict[str, SyntheticSource]:
    return {name: SyntheticSource(SyntheticConfig(scene=name, frames=300), 0) for name in ("blank", "desk", "corridor")}


def in_camera(plane_w: np.ndarray, T_wc: np.ndarray) -> tuple[np.ndarray, float]:
    return T_wc[:3, :3].T @ plane_w[:3], float(plane_w[3] + plane_w[:3] @ T_wc[:3, 3])


@pytest.mark.parametrize("scene", ["blank", "desk", "corridor"])
def test_rooms_under_sensor_noise(sources, scene):
    source = sources[scene]
    errors = []
    for index in (10, 90, 200):
        depth_m, labels = source.read(index).depth_m, source.labels(index)
        view = extract_planes(runtime.to_device(depth_m), source.camera, CONFIG, SensorNoise(SIGMA))
        on_planes = (view.labels >= 0)[(labels >= 0) & (depth_m > 0)].mean()
        assert on_planes > 0.8
        for k, segment in enumerate(view.segments):
            if segment.reliable:
                mine = labels[view.labels == k]
                most = np.bincount(mine[mine >= 0]).argmax()
                normal, offset_m = in_camera(source.planes()[most], source.pose(index))
                angle_deg = np.degrees(np.arccos(np.clip(normal @ segment.normal_c, -1, 1)))
                errors.append((angle_deg, 1e3 * abs(normal @ segment.centroid_c + offset_m)))
    angle_deg, offset_mm = np.array(errors).T
    assert len(errors) >= 9
    assert np.median(angle_deg) < 0.2 and np.median(offset_mm) < 1.0
    assert (angle_deg < 1.0).mean() > 0.85 and (offset_mm < 10.0).all()


def test_it_repeats_bit_for_bit(sources):
    depth_m = sources["desk"].read(40).depth_m
    first, second = (
        extract_planes(runtime.to_device(depth_m), sources["desk"].camera, CONFIG, SensorNoise(SIGMA)) for _ in range(2)
    )
    np.testing.assert_array_equal(first.labels, second.labels)
    for a, b in zip(first.segments, second.segments, strict=True):
        np.testing.assert_array_equal(a.normal_c, b.normal_c)
        np.testing.assert_array_equal(a.covariance, b.covariance)
        assert (a.offset_m, a.area_m2, a.rms_m) == (b.offset_m, b.area_m2, b.rms_m)


def test_the_depth_image_is_left_alone(sources):
    depth_m = sources["desk"].read(40).depth_m
    before = depth_m.copy()
    extract_planes(runtime.to_device(depth_m), sources["desk"].camera, CONFIG, SensorNoise(SIGMA))
    np.testing.assert_array_equal(depth_m, before)


def test_a_sensor_noisier_than_assumed_still_shows_its_planes():
    normal = np.array([0.1, -0.6, -1.0]) / np.linalg.norm([0.1, -0.6, -1.0])
    exact_m = plane_depth(normal, 1.2)
    noise = 3.0 * SIGMA * np.random.default_rng(0).normal(size=exact_m.shape)
    view = seen(1.0 / (1.0 / exact_m + noise), None)
    assert view.segments[0].area_px > 0.95 * exact_m.size
    assert view.segments[0].rms_sigmas == pytest.approx(3.0, rel=0.05)
    assert_true(view.segments[0], normal, 1.2, 0.05, 0.001)
    error = deviation(view.segments[0], normal, 1.2)
    assert error @ np.linalg.solve(view.segments[0].covariance, error) < 16.0
