"""Surfaces a little before a larger one: found in single views, kept apart by the registry, told to earlier views."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.plane_views import NOISE, Rectangle, Watched, cast, looking, points_c, segment_of
from tgslam.camera import Camera
from tgslam.config.graph_settings import LoopConfig
from tgslam.config.plane_settings import PlanesConfig
from tgslam.device import runtime
from tgslam.map.keyframes import Keyframe
from tgslam.map.world import Map
from tgslam.mapping.plane_observation import PlaneObserver
from tgslam.ops.plane_fit import CellGrid
from tgslam.planes.segment import PlaneView
from tgslam.planes.segmentation.cells import planar_cells
from tgslam.planes.segmentation.extraction import extract_planes
from tgslam.planes.segmentation.layers import bordering, part_layers, settle
from tgslam.planes.segmentation.merging import Agreement
from tgslam.types import Exposure, Frame

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
CONFIG = PlanesConfig()
LIMITS = CONFIG.expert.segmentation
WALL = Rectangle((0.0, 2.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (6.0, 3.0))
BOARD = Rectangle((0.0, 1.985, 0.6), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (6.0, 0.08))
ALONG = [looking((x, 0.0, 1.2), (x + 0.1, 2.0, 0.9)) for x in np.linspace(-0.5, 0.5, 8)]


def measured(rectangles: list[Rectangle], T_cw: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Depth with the sensor's noise, and the rectangle of each pixel."""
    depth_m, labels = cast(rectangles, CAMERA, T_cw)
    noise = NOISE.sigma_m(depth_m) * np.random.default_rng(seed).standard_normal(depth_m.shape)
    return np.where(depth_m > 0, depth_m + noise, 0.0).astype(np.float32), labels


def seen(depth_m: np.ndarray) -> PlaneView:
    return extract_planes(runtime.to_device(depth_m), CAMERA, CONFIG, NOISE)


def rolled(T_cw: np.ndarray, roll_deg: float) -> np.ndarray:
    """The camera, turned about its line of sight."""
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    return np.asarray(turn @ T_cw)


def of_board(view: PlaneView, labels: np.ndarray) -> int:
    """The segment that most of the board's pixels belong to."""
    return int(np.argmax(np.bincount(view.labels[labels == 1] + 1)) - 1)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_board_on_a_wall_is_a_segment_of_its_own_and_parallel_to_it(seed: int) -> None:
    depth_m, labels = measured([WALL, BOARD], ALONG[3], seed)
    view = seen(depth_m)
    board = of_board(view, labels)
    assert board > 0
    assert np.mean(view.labels[labels == 1] == board) > 0.7
    assert np.mean(view.labels[labels == 0] == board) < 0.02
    assert (board, 0) in view.steps
    segment, wall = view.segments[board], view.segments[0]
    assert segment.normal_c @ wall.normal_c == pytest.approx(1.0, abs=1e-9)
    assert wall.offset_m - segment.offset_m == pytest.approx(0.015, abs=0.004)
    np.testing.assert_allclose(segment.covariance[:2, :2], wall.covariance[:2, :2])


FAR_WALL = Rectangle((0.0, 3.7, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (8.0, 4.0))
FAR_BOARD = Rectangle((0.0, 3.68, 0.6), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (3.0, 0.08))


def measured_alike(rectangles: list[Rectangle], T_cw: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """As `measured`, where neighbouring pixels err alike: as if a sixth of them were measured."""
    depth_m, labels = cast(rectangles, CAMERA, T_cw)
    white = np.random.default_rng(seed).standard_normal(depth_m.shape)
    kernel = cv2.getGaussianKernel(5, 0.7)
    noise = cv2.sepFilter2D(white, -1, kernel, kernel) / np.sum(kernel**2)
    return np.where(depth_m > 0, depth_m + NOISE.sigma_m(depth_m) * noise, 0.0).astype(np.float32), labels


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("roll_deg", [0.0, 30.0])
def test_a_strip_that_no_cell_tells_from_the_wall_is_found_along_it_and_kept(seed: int, roll_deg: float) -> None:
    T_cw = rolled(looking((0.0, 0.0, 1.2), (0.0, 3.7, 0.8)), roll_deg)
    depth_m, labels = measured_alike([FAR_WALL, FAR_BOARD], T_cw, seed)
    grid = CellGrid(CAMERA, 4)
    graph = planar_cells(runtime.to_device(depth_m), grid, NOISE.per_m2, LIMITS.cell_share, LIMITS.cell_sigmas)
    board = labels.reshape(60, 4, 80, 4).mean(axis=(1, 3)).ravel()[graph.cell]
    agreement = Agreement(NOISE.per_m2, LIMITS.join_sigmas, 0.0, LIMITS.join_shift_m)
    group, parent = part_layers(graph, grid.shape, np.zeros(len(board), np.intp), agreement, 230.0, CONFIG.expert.steps)
    strip = np.isin(group, np.flatnonzero(parent == 0))
    assert np.mean(board[strip] > 0.1) > 0.6
    assert np.mean(strip[board > 0.9]) > 0.4
    kept = settle(graph, grid.shape, group, 5000.0, parent)
    wall = np.bincount(kept[board == 0]).argmax()
    assert np.mean(kept[strip & (board > 0.9)] != wall) == 1.0
    lost = settle(graph, grid.shape, group, 5000.0)
    assert np.mean(lost[strip & (board > 0.9)] == np.bincount(lost[board == 0]).argmax()) > 0.2


@pytest.mark.parametrize("seed", range(8))
def test_a_far_wall_without_a_board_is_one_surface(seed: int) -> None:
    depth_m, _ = measured_alike([FAR_WALL], looking((0.0, 0.0, 1.2), (0.3, 3.7, 0.8)), seed)
    view = seen(depth_m)
    assert len(view.segments) == 1
    assert not view.steps


def test_a_narrow_surface_is_not_turned_by_the_edge_beside_it() -> None:
    # The side of a shelf, at a grazing angle, and the front of the same board
    side = Rectangle((0.0, 3.15, 1.2), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (0.3, 2.0))
    edge = Rectangle((0.0125, 3.0, 1.2), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.025, 2.0))
    T_cw = looking((-0.75, 0.0, 1.2), (0.0, 3.0, 1.2))
    errors_deg = []
    for seed in range(6):
        depth_m, labels = measured_alike([side, edge], T_cw, seed)
        view = seen(depth_m)
        found = int(np.argmax(np.bincount(view.labels[labels == 0] + 1)[1:]))
        cosine = abs(view.segments[found].normal_c @ T_cw[:3, 0])
        errors_deg.append(np.degrees(np.arccos(min(cosine, 1.0))))
    assert np.mean(errors_deg) < 1.0, errors_deg


@pytest.mark.parametrize("wave_m", [0.0, 0.004])
def test_a_wall_without_a_board_is_one_surface_even_where_it_is_not_quite_plane(wave_m: float) -> None:
    depth_m, _ = measured([WALL], ALONG[3])
    columns = np.arange(CAMERA.width)
    view = seen((depth_m + wave_m * np.sin(columns / 40.0)).astype(np.float32))
    assert len(view.segments) == 1
    assert not view.steps


def settled(depth_m: np.ndarray, small_rows: slice) -> np.ndarray:
    """The group of each cell, -1 = none, of a wall that a post hides a strip of.

    What is left of the post starts as one large group, its right side between those rows of cells as a small one.
    """
    grid = CellGrid(CAMERA, 4)
    graph = planar_cells(runtime.to_device(depth_m), grid, NOISE.per_m2, LIMITS.cell_share, LIMITS.cell_sigmas)
    start = np.full(grid.shape, -1)
    start[:, :66] = 0
    start[small_rows, 66:] = 1
    groups = np.full(grid.shape, -1)
    groups.ravel()[graph.cell] = settle(graph, grid.shape, start.ravel()[graph.cell], large_px=5000.0)
    return groups


def behind_a_post(board: tuple[slice, slice], step_m: float, seed: int) -> np.ndarray:
    """Depth of a wall, four times as noisy as the sensor should be, with a board on it; none where the post stands."""
    depth_m = np.full(CAMERA.shape, 2.0)
    depth_m[board] -= step_m
    depth_m += 4.0 * NOISE.per_m2 * np.random.default_rng(seed).standard_normal(depth_m.shape)
    depth_m[:, 260:272] = 0.0
    return depth_m.astype(np.float32)


def alike(groups: np.ndarray) -> float:
    """Of the cells of any group, the share that the largest one has."""
    return float(np.bincount(groups[groups >= 0]).max() / np.sum(groups >= 0))


@pytest.mark.parametrize("step_m", [0.008, 0.012])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_small_group_half_on_a_hidden_wall_gives_the_wall_back(step_m: float, seed: int) -> None:
    groups = settled(behind_a_post(np.s_[100:140, 280:320], step_m, seed), slice(25, 45))
    board, wall = groups[25:35, 70:], groups[36:45, 68:]
    assert alike(board) > 0.98
    assert alike(wall) > 0.98
    assert np.median(board[board >= 0]) != np.median(wall[wall >= 0])


@pytest.mark.parametrize(("step_m", "seed"), [(0.004, 0), (0.005, 3)])
def test_a_narrow_board_keeps_the_few_cells_that_noise_puts_on_the_wall(step_m: float, seed: int) -> None:
    groups = settled(behind_a_post(np.s_[100:108, 272:320], step_m, seed), slice(25, 27))
    assert alike(groups[25:27, 68:]) == 1.0


def test_the_registry_keeps_a_board_and_its_wall_apart() -> None:
    registry = Watched(CONFIG)
    ids = []
    for keyframe, T_cw in enumerate(ALONG):
        depth_m, labels = measured([WALL, BOARD], T_cw, keyframe)
        view = seen(depth_m)
        found = registry.show(view, depth_m, CAMERA, T_cw, keyframe)
        ids.append((found.ids[0], found.ids[of_board(view, labels)]))
    walls, boards = {wall for wall, _ in ids}, {board for _, board in ids if board >= 0}
    assert len(walls) == len(boards) == 1
    assert walls != boards
    (board,), (wall,) = boards, walls
    assert [other.id for other in registry.parted_from(board)] == [wall]
    normal = registry.instances[board].normal_w
    assert np.degrees(np.arccos(min(normal @ registry.instances[wall].normal_w, 1.0))) < 0.3


FAR = looking((0.2, -2.0, 1.2), (0.2, 2.0, 0.7))  # 4 m off: the noise is larger than the step, the board 5 px wide


def told_of_a_board() -> Watched:
    """A registry that knows a board on a wall from nearby."""
    registry = Watched(CONFIG)
    for keyframe, T_cw in enumerate(ALONG[::2]):
        depth_m, _ = measured([WALL, BOARD], T_cw, keyframe)
        registry.show(seen(depth_m), depth_m, CAMERA, T_cw, keyframe)
    return registry


@pytest.mark.parametrize("seed", range(4))
def test_a_far_view_shows_a_board_that_it_could_not_tell_by_itself(seed: int) -> None:
    depth_m, labels = measured([WALL, BOARD], FAR, seed)
    alone = seen(depth_m)
    assert of_board(alone, labels) == 0
    registry = told_of_a_board()
    view = registry.with_known_steps(alone, depth_m, CAMERA, FAR)
    assert len(view.segments) == len(alone.segments) + 1
    part, found, board = view.segments[-1], view.labels == len(alone.segments), labels == 1
    assert np.mean(board[found]) > 0.7  # its window takes in a row of the wall
    known = np.abs(points_c(CAMERA, depth_m)[..., 0]) < 1.2
    assert np.mean(found[board & known]) > 0.7
    np.testing.assert_array_equal(view.labels[~found], alone.labels[~found])
    assert part.area_px == found.sum()
    assert part.area_px + view.segments[0].area_px == alone.segments[0].area_px
    assert part.offset_m < view.segments[0].offset_m - 0.007
    assert abs(part.normal_c @ part.centroid_c + part.offset_m) < 0.001
    assert not part.reliable
    observed = registry.show(view, depth_m, CAMERA, FAR, 9)
    (parted,) = registry.parted_from(int(observed.ids[0]))
    assert observed.ids[-1] == parted.id


@pytest.mark.parametrize("seed", range(4))
def test_a_bare_wall_shows_no_board_where_there_was_one(seed: int) -> None:
    depth_m, _ = measured([WALL], FAR, seed)
    alone = seen(depth_m)
    assert told_of_a_board().with_known_steps(alone, depth_m, CAMERA, FAR) is alone


@pytest.mark.parametrize("target", [(0.2, -6.0, 0.7), (6.0, -2.0, 0.7)])
def test_a_view_elsewhere_is_left_as_it_is(target: tuple[float, float, float]) -> None:
    T_cw = looking((0.2, -2.0, 1.2), target)
    depth_m, _ = measured([Rectangle(target, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (3.0, 6.0))], T_cw)
    alone = seen(depth_m)
    assert told_of_a_board().with_known_steps(alone, depth_m, CAMERA, T_cw) is alone


def test_a_view_that_tells_the_board_itself_is_left_as_it_is() -> None:
    depth_m, labels = measured([WALL, BOARD], ALONG[3], 5)
    alone = seen(depth_m)
    assert of_board(alone, labels) > 0
    assert told_of_a_board().with_known_steps(alone, depth_m, CAMERA, ALONG[3]) is alone


class Observed:
    """Keyframes of which only the planes are looked at."""

    def __init__(self) -> None:
        config = replace(CONFIG, enabled=True)
        self.map = Map(CAMERA, NOISE, LoopConfig(), config)
        self.observer = PlaneObserver(CAMERA, config, NOISE)

    def observe(self, T_cw: np.ndarray, depth_m: np.ndarray) -> None:
        frame = Frame(len(self.map.keyframes), 0.0, np.zeros((*depth_m.shape, 3), np.float32), depth_m)
        self.map.keyframes.add(Keyframe(frame, T_cw, Exposure(), np.eye(6)))
        self.observer.observe(self.map)

    def shown(self, number: int) -> np.ndarray:
        """[H, W] the PGI of each pixel of a keyframe."""
        labels = self.map.keyframes[number].labels
        assert labels is not None
        return labels.image()

    @property
    def instances(self) -> dict:
        assert self.map.planes is not None
        return self.map.planes.instances


def test_keyframes_before_a_plane_was_confirmed_show_it_too() -> None:
    world, masks = Observed(), []
    for index, T_cw in enumerate(ALONG):
        depth_m, labels = measured([WALL, BOARD], T_cw, index)
        masks.append(labels == 1)
        world.observe(T_cw, depth_m)
    latest = world.shown(-1)[masks[-1]]
    board = int(np.bincount(latest[latest >= 0]).argmax())
    assert min(world.instances[board].keyframes) == 0
    assert np.mean(world.shown(0)[masks[0]] == board) > 0.6


def test_a_surface_that_waits_for_other_views_is_no_part_of_the_floor_that_it_stands_on() -> None:
    floor = Rectangle((0.0, 0.0, 0.56), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (6.0, 4.0))
    world = Observed()
    for index, T_cw in enumerate(ALONG[:2]):
        depth_m, labels = measured([WALL, BOARD, floor], T_cw, index)
        world.observe(T_cw, depth_m)
        view = seen(world.map.keyframes[-1].depth_m())
        waiting = view.labels == of_board(view, labels)
        assert waiting.sum() > 500
        assert (world.shown(-1)[waiting] == -1).all()


def test_keyframes_show_in_the_end_what_only_later_ones_have_seen_of_a_plane() -> None:
    world = Observed()
    speck = np.zeros(CAMERA.shape, bool)
    speck[110:122, 240:252] = True
    for index, T_cw in enumerate(ALONG[:3]):
        depth_m, _ = measured([WALL], T_cw, index)
        if index == 0:  # nothing of the right half but a speck, which is less than a segment
            depth_m[:, 150:][~speck[:, 150:]] = 0.0
        world.observe(T_cw, depth_m)
    (wall,) = world.instances
    first, keyframes = world.shown(0), world.map.keyframes
    versions = [keyframe.label_version for keyframe in keyframes]
    assert (first[speck] == -1).all()
    world.observer.complete(world.map)
    assert np.mean(world.shown(0)[speck] == wall) > 0.9
    known = (first >= 0) | (keyframes[0].depth_m() == 0)
    np.testing.assert_array_equal(world.shown(0)[known], first[known])
    assert keyframes[0].label_version > versions[0]
    assert keyframes[1].label_version == versions[1]  # nothing to tell


def test_bordering_labels_are_listed_in_both_orders() -> None:
    labels = np.array([[0, 0, 1], [-1, 2, 1]], np.int32)
    assert bordering(labels).tolist() == [[0, 1], [0, 2], [1, 0], [1, 2], [2, 0], [2, 1]]
    assert len(bordering(np.full((2, 2), -1, np.int32))) == 0


def test_a_boards_extent_is_not_worn_away_by_the_wall_beside_it() -> None:
    registry = Watched(CONFIG)
    for keyframe in range(12):
        depth_m, labels = measured([WALL, BOARD], ALONG[4], keyframe)
        view = seen(depth_m)
        found = registry.show(view, depth_m, CAMERA, ALONG[4], keyframe)
    board = registry.instances[int(found.ids[of_board(view, labels)])]
    wall = registry.instances[int(found.ids[0])]
    in_view = Rectangle((0.1, 1.985, 0.6), BOARD.along, BOARD.across, (2.0, 0.08))
    x, z = np.meshgrid(np.linspace(-0.9, 0.9, 37), [-0.01, 0.01])
    places = np.array(in_view.centre) + np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    assert np.mean(board.support.holds(board.support.cells_of(places))) > 0.95
    assert np.mean(wall.support.holds(wall.support.cells_of(places))) < 0.3


def labelled(depth_m: np.ndarray, labels: np.ndarray, planes_c: list[np.ndarray]) -> PlaneView:
    """What a segmenter shows whose segments are these labels [H, W], with these planes [4] in the camera's frame."""
    rng, points = np.random.default_rng(0), points_c(CAMERA, depth_m)
    area_m2 = depth_m**2 / CAMERA.fx**2
    segments = [segment_of(points[labels == k], plane, area_m2[labels == k], rng) for k, plane in enumerate(planes_c)]
    return PlaneView(labels.astype(np.int32), tuple(segments))


def test_a_piece_of_a_surface_is_not_taken_for_a_smaller_one_before_it_that_the_view_does_not_show() -> None:
    patch = Rectangle((0.35, 1.975, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.4, 0.3))
    T_cw = looking((0.0, 0.0, 1.0), (0.0, 2.0, 1.0))
    depth_m, labels = cast([WALL, patch], CAMERA, T_cw)
    wall, front, between = (np.array([0.0, 0.0, -1.0, z]) for z in (2.0, 1.975, 1.985))
    registry = Watched(CONFIG)
    first = registry.show(labelled(depth_m, labels, [wall, front]), depth_m, CAMERA, T_cw, 0)
    halves = np.zeros_like(labels)
    halves[:, 150:] = -1
    halves[70:170, 170:280] = 1
    second = registry.show(labelled(depth_m, halves, [wall, between]), depth_m, CAMERA, T_cw, 1)
    assert second.ids.tolist() == [first.ids[0], first.ids[0]]
    assert registry.instances[int(first.ids[1])].keyframes == [0]
