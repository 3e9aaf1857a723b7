"""Planar instances over whole sequences: identity, growth, merging, splitting, removal; segments are the truth's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.plane_views import NOISE, Playback, Rectangle, Stage, looking
from tests.tiers import changed
from tgslam.config.plane_settings import PlanesConfig
from tgslam.geometry import inverse, se3_exp, tangent_axes
from tgslam.planes.estimate import PlaneEstimate, deviation_sigmas
from tgslam.planes.identity.palette import colours
from tgslam.planes.instances.instance import PlanarInstance
from tgslam.planes.instances.joining import Joining
from tgslam.planes.instances.sight import Tolerance

CLEAR_M = 0.05  # planes of the scenes that stand closer to a parallel one are not told apart for certain
WALL = Rectangle((0.0, 3.0, 1.25), (1, 0, 0), (0, 0, 1), (5.0, 2.5))
FLOOR = Rectangle((0.0, 1.5, 0.0), (1, 0, 0), (0, 1, 0), (5.0, 5.0))
SIDE = Rectangle((2.5, 1.5, 1.25), (0, 1, 0), (0, 0, 1), (3.0, 2.5))
HERE = looking((0.0, 0.0, 1.4), (0.3, 3.0, 0.9))
TABLES = [
    Rectangle((-0.7, 2.0, 0.75), (1, 0, 0), (0, 1, 0), (1.0, 0.8)),
    Rectangle((0.7, 2.0, 0.75), (1, 0, 0), (0, 1, 0), (1.0, 0.8)),
]


def wandering(steps: int, width_m: float = 0.6) -> list[np.ndarray]:
    """Poses that look about in front of the wall."""
    phases = np.linspace(0, 2 * np.pi, steps, endpoint=False)
    return [
        looking((width_m * float(np.sin(p)), 0.2 * float(np.cos(p)), 1.4), (1.2 * float(np.sin(p)), 3.0, 0.8))
        for p in phases
    ]


def clear_planes(playback: Playback) -> dict[int, list[int]]:
    """The ids of the true planes over 0.2 m2: of the large ones, and of those that nothing parallel stands close to.

    A skirting 1.5 cm in front of a wall is not told apart from it for certain.
    """
    ids, planes = playback.ids_of_planes(0.2), playback.source.planes()
    large = playback.ids_of_planes(1.0)
    seen = list(ids)
    normals, offsets = planes[seen, :3], planes[seen, 3]
    alike = (normals @ normals.T > 0.99) & (np.abs(offsets[:, None] - offsets) < CLEAR_M)
    return {label: ids[label] for i, label in enumerate(seen) if label in large or alike[i].sum() == 1}


@pytest.mark.parametrize(
    ("scene", "frames", "pieces", "pose_sigma", "least"),
    [
        ("room", 350, 1, (0.0, 0.0), 12),
        ("room", 300, 3, (0.001, 0.003), 7),
        ("turn", 500, 1, (0.0, 0.0), 12),
        ("turn", 500, 2, (0.001, 0.003), 8),
        ("desk", 660, 1, (0.0, 0.0), 12),
        ("loop", 520, 1, (0.0, 0.0), 14),
        ("corridor", 400, 1, (0.001, 0.003), 5),
    ],
)
def test_every_plane_has_one_id_for_ever(
    scene: str, frames: int, pieces: int, pose_sigma: tuple[float, float], least: int
) -> None:
    playback = Playback(scene, frames=frames, pieces=pieces, pose_sigma=pose_sigma, seed=pieces)
    playback.play(range(0, frames, 10))
    clear = clear_planes(playback)
    assert len(clear) >= least
    for label, ids in clear.items():
        found, counts = np.unique(ids, return_counts=True)
        assert len(found) == 1, f"plane {label}: ids {found} in {counts} views"
    assert len({ids[0] for ids in clear.values()}) == len(clear)


def test_walls_floor_and_ceiling_keep_their_id_when_they_come_back() -> None:
    playback = Playback("turn", frames=520).play(range(0, 520, 10))  # one and a half times round
    ids = playback.ids_of_planes(0.2)
    for label in range(1, 6):  # floor and walls; skirtings stand 1.5 cm before the walls
        first, last = ids[label][0], ids[label][-1]
        assert first == last, f"plane {label} came back as {last} instead of {first}"


def test_the_fitted_planes_are_as_true_as_they_say() -> None:
    playback = Playback("desk", frames=660).play(range(0, 660, 15))
    planes, instances = playback.source.planes(), playback.registry.instances
    sigmas = []
    for label, ids in clear_planes(playback).items():
        found, normal = instances[ids[0]].plane, planes[label, :3]
        foot = found.centroid - (normal @ found.centroid + planes[label, 3]) * normal
        exact = PlaneEstimate(normal, planes[label, 3], foot, tangent_axes(normal), np.zeros((3, 3)))
        sigmas.append(float(deviation_sigmas(found, exact)))
        assert abs(normal @ found.centroid + planes[label, 3]) < 0.01
        assert np.rad2deg(np.arccos(min(1.0, normal @ found.normal))) < (0.3 if len(ids) > 5 else 1.0)
        assert 0.0005 < np.sqrt(found.covariance[2, 2]) < 0.02  # many views do not make it certain
    assert max(sigmas) < 3.5


def test_the_same_views_give_the_same_planes() -> None:
    def run() -> list[tuple[int, float, float]]:
        instances = Playback("room", frames=200).play(range(0, 200, 20)).registry.instances
        return [(i, instance.offset_m, instance.area_m2) for i, instance in instances.items()]

    assert run() == run()


def test_an_instance_tells_what_it_is() -> None:
    stage = Stage([WALL, FLOOR])
    for T_cw in wandering(5):
        _, ids = stage.show(T_cw)
    wall = stage.registry.instances[ids[0][0]]
    assert_allclose(wall.normal_w, [0, -1, 0], atol=0.01)
    assert_allclose(wall.offset_m, 3.0, atol=0.02)
    assert wall.keyframes == [0, 1, 2, 3, 4]
    assert wall.covariance.shape == (3, 3)
    assert (wall.colour == colours(wall.id)).all()
    assert 3.0 < wall.area_m2 < 12.5
    assert 0.001 < wall.rms_m < 0.05
    polygon = wall.polygons_w()[0]
    assert_allclose(polygon @ wall.normal_w + wall.offset_m, 0.0, atol=1e-9)
    local = stage.registry.seen_from(4)[wall.id]
    assert local.offset_m > 0


def test_the_two_sides_of_a_thin_wall_are_two() -> None:
    thin = Rectangle((0.0, 3.0, 1.25), (1, 0, 0), (0, 0, 1), (2.0, 2.5))
    stage = Stage([thin, replace(thin, centre=(0.0, 3.03, 1.25)), FLOOR])
    _, front = stage.show(looking((0.0, 0.5, 1.4), (0.0, 3.0, 1.0)))
    _, back = stage.show(looking((0.0, 5.5, 1.4), (0.0, 3.0, 1.0)))
    _, again = stage.show(looking((0.2, 0.5, 1.4), (0.0, 3.0, 1.0)))
    assert front[0] != back[1]
    assert front[0] == again[0]
    assert_allclose(
        stage.registry.instances[front[0][0]].normal_w, -stage.registry.instances[back[1][0]].normal_w, atol=0.03
    )


@pytest.mark.parametrize("sideways_m", [0.0, 1.2])
def test_two_coplanar_table_tops_stay_two(sideways_m: float) -> None:
    stage = Stage([*TABLES, FLOOR, WALL])
    for x in np.linspace(-sideways_m, sideways_m, 8):
        _, ids = stage.show(looking((float(x), 0.4, 1.5), (float(x), 2.0, 0.75)))
    everything, ids = stage.show(looking((0.0, 0.2, 1.6), (0.0, 2.0, 0.75)))
    assert everything.merged == ()
    assert ids[0] != ids[1]
    assert -1 not in ids[0] + ids[1]


def test_table_tops_stay_two_before_a_partition_that_hides_the_far_end_of_their_gap() -> None:
    partition = Rectangle((0.0, 2.44, 0.7), (1, 0, 0), (0, 0, 1), (3.0, 1.4))
    stage = Stage([*TABLES, partition, FLOOR])
    for x in np.linspace(-0.5, 0.5, 5):
        _, ids = stage.show(looking((float(x), 0.3, 1.5), (0.0, 2.0, 0.75)))
        assert ids[0] != ids[1]
    assert len(stage.registry.instances) == 4


@pytest.mark.parametrize(("width_m", "surfaces"), [(1.6, 1), (0.8, 2)])
def test_a_gap_that_no_view_shows_parts_small_surfaces_only(width_m: float, surfaces: int) -> None:
    tops = [Rectangle((x, 2.0, 0.75), (1, 0, 0), (0, 1, 0), (width_m, 0.9)) for x in (-width_m, width_m)]
    stage = Stage(tops)
    for x in (-width_m, width_m):
        stage.show(looking((x, 1.0, 2.0), (x, 2.01, 0.75)))
    assert len(stage.registry.instances) == surfaces


def test_far_ends_of_a_floor_are_one_though_nothing_between_them_was_seen() -> None:
    hall = [
        replace(FLOOR, centre=(0.0, 1.5, 0.0), size=(14.0, 5.0)),
        replace(WALL, size=(14.0, 2.5)),
        replace(SIDE, centre=(-7.0, 1.5, 1.25)),
        replace(SIDE, centre=(7.0, 1.5, 1.25)),
    ]
    stage = Stage(hall)
    _, left = stage.show(looking((-4.5, 0.0, 1.4), (-6.0, 2.0, 0.2)))
    _, right = stage.show(looking((4.5, 0.0, 1.4), (6.0, 2.0, 0.2)))
    assert stage.registry.living(left[0][0]) == right[0][0]
    assert stage.registry.living(left[1][0]) == right[1][0]
    assert len(set(right[0] + right[1])) == 2


def test_far_table_tops_are_two_since_the_floor_lies_behind_them() -> None:
    tops = [Rectangle((x, 2.0, 0.75), (1, 0, 0), (0, 1, 0), (1.6, 0.9)) for x in (-4.0, 4.0)]
    stage = Stage([*tops, replace(FLOOR, size=(14.0, 6.0))])
    for x in (-4.0, 4.0):
        stage.show(looking((x, 0.2, 2.0), (x, 2.01, 0.75)))
    tables = [plane for plane in stage.registry.instances.values() if abs(plane.offset_m + 0.75) < 0.03]
    assert len(tables) == 2


ROWS = [Rectangle((0.0, 2.8, z), (1, 0, 0), (0, 0, 1), (0.8, 0.3)) for z in (0.9, 1.3)]  # 10 cm apart


def test_rows_of_books_stay_apart_where_the_wall_shows_between_them() -> None:
    stage = Stage([*ROWS, WALL, FLOOR])
    for x in np.linspace(-0.4, 0.4, 6):
        seen, ids = stage.show(looking((float(x), 1.0, 1.3), (0.0, 3.0, 1.1)))
        assert ids[0] != ids[1]
        assert seen.merged == ()
    assert stage.registry.parted_from(ids[0][0]) == [stage.registry.instances[ids[1][0]]]


@pytest.mark.parametrize(("size", "surfaces"), [((0.8, 0.3), 2), ((2.4, 0.6), 1)])
def test_a_board_parts_small_fronts_only(size: tuple[float, float], surfaces: int) -> None:
    height = 0.5 * size[1] + 0.02
    fronts = [Rectangle((0.0, 2.8, 1.2 + z), (1, 0, 0), (0, 0, 1), size) for z in (-height, height)]
    board = Rectangle((0.0, 2.75, 1.2), (1, 0, 0), (0, 0, 1), (3.0, 0.06))
    stage = Stage([*fronts, board, WALL])
    for x in np.linspace(-0.3, 0.3, 4):
        _, ids = stage.show(looking((float(x), 0.9, 1.25), (0.0, 3.0, 1.2)))
    assert len({ids[0][0], ids[1][0]}) == surfaces


@pytest.mark.parametrize(("often", "surfaces"), [(4, 1), (2, 2)])
def test_what_most_views_do_not_show_in_a_gap_parts_nothing(often: int, surfaces: int) -> None:
    """Something fills the gap in each `often`th view, and a rail far before it hides it in the others."""
    fronts = [Rectangle((0.0, 2.8, 1.2 + z), (1, 0, 0), (0, 0, 1), (0.8, 0.3)) for z in (-0.17, 0.17)]
    board = Rectangle((0.0, 2.75, 1.2), (1, 0, 0), (0, 0, 1), (3.0, 0.06))
    rail = Rectangle((0.0, 2.3, 1.21), (1, 0, 0), (0, 0, 1), (3.0, 0.06))
    stage = Stage([*fronts, WALL])
    for view, x in enumerate(np.linspace(-0.3, 0.3, 13)):
        before = rail if view % often else board
        _, ids = stage.show(looking((float(x), 0.9, 1.25), (0.0, 3.0, 1.2)), rectangles=[*fronts, WALL, before])
    assert len({*ids[0], *ids[1]}) == surfaces
    assert len({stage.registry.living(found[0]) for found in (ids[0], ids[1])}) == surfaces


def test_what_was_taken_for_one_surface_is_parted_when_views_look_through_it() -> None:
    stage = Stage([*ROWS, WALL, FLOOR])
    both = Rectangle((0.0, 2.8, 1.1), (1, 0, 0), (0, 0, 1), (0.8, 0.7))
    _, far = stage.show(looking((0.0, 0.0, 1.3), (0.0, 3.0, 1.1)), rectangles=[both, WALL, FLOOR])
    for x in np.linspace(-0.3, 0.3, 4):
        _, ids = stage.show(looking((float(x), 1.0, 1.3), (0.0, 3.0, 1.1)))
    assert far[0][0] in ids[0] + ids[1]
    assert ids[0] != ids[1]
    first, second = (stage.registry.instances[found[0]].support for found in (ids[0], ids[1]))
    assert not first.holds(first.cells_of(second.centres(second.cells()[0]))).any()
    assert len(stage.registry.instances) == 4


def test_a_bent_piece_becomes_part_of_the_surface_to_which_views_count_it() -> None:
    bend = np.deg2rad(7.0)
    bent = Rectangle((1.2, 2.97, 1.2), (np.cos(bend), np.sin(bend), 0), (0, 0, 1), (0.5, 0.5))
    stage = Stage([WALL, FLOOR])
    _, ids = stage.show(HERE, rectangles=[WALL, FLOOR, bent])
    scrap, wall = ids[2][0], ids[0][0]
    assert scrap != wall
    merged = [stage.show(T_cw)[0].merged for T_cw in wandering(6)]
    assert merged.count(((wall, scrap),)) == 1
    assert merged[0] == merged[1] == ()  # not at the first view
    assert stage.registry.living(scrap) == wall
    assert_allclose(stage.registry.instances[wall].normal_w, [0, -1, 0], atol=0.005)


def test_a_bent_piece_is_not_kept_by_a_sliver_of_it_that_views_show_again() -> None:
    bend = np.deg2rad(7.0)
    bent = Rectangle((1.2, 2.97, 1.2), (np.cos(bend), np.sin(bend), 0), (0, 0, 1), (0.6, 1.2))
    stage = Stage([WALL, FLOOR, replace(bent, size=(0.11, 1.2))])
    _, ids = stage.show(HERE, rectangles=[WALL, FLOOR, bent])
    scrap, wall = ids[2][0], ids[0][0]
    for x in (0.0, 0.1):
        seen, ids = stage.show(looking((x, 0.0, 1.4), (0.9, 3.0, 1.0)))
        assert ids[2] == [scrap]
        assert seen.merged == ()
    seen, _ = stage.show(looking((0.2, 0.0, 1.4), (0.9, 3.0, 1.0)), rectangles=[WALL, FLOOR])
    assert seen.merged == ((wall, scrap),)


def test_a_wall_that_something_hides_in_part_is_one() -> None:
    pillar = Rectangle((0.0, 2.0, 1.25), (1, 0, 0), (0, 0, 1), (0.3, 2.5))
    _, ids = Stage([WALL, pillar, FLOOR]).show(HERE)
    assert len(ids[0]) == 1
    stage = Stage([WALL, pillar, FLOOR])
    _, ids = stage.show(HERE, pieces=4)
    assert len(set(ids[0])) == 1
    assert ids[0] != ids[1]


def test_a_wall_cut_at_random_is_one() -> None:
    stage = Stage([WALL, FLOOR, SIDE])
    for T_cw in wandering(12):
        _, ids = stage.show(T_cw, pieces=3)
    for found in ids.values():
        assert len({stage.registry.living(plane_id) for plane_id in found}) == 1
    assert len(stage.registry.instances) == 3


def test_parts_of_a_wall_that_were_seen_apart_become_one_when_the_rest_is_seen() -> None:
    small = replace(WALL, size=(4.0, 2.0))
    stage = Stage([small], changed(PlanesConfig(), bridge_m=0.0))
    _, left = stage.show(looking((-1.8, 2.0, 1.2), (-1.8, 3.0, 1.2)))
    _, right = stage.show(looking((1.8, 2.0, 1.2), (1.8, 3.0, 1.2)))
    assert left[0] != right[0]
    seen, both = stage.show(looking((0.0, 0.5, 1.2), (0.0, 3.0, 1.2)))
    assert seen.merged == ((left[0][0], right[0][0]),)
    assert both[0] == left[0]
    assert stage.registry.living(right[0][0]) == left[0][0]
    assert stage.registry.instances[left[0][0]].keyframes == [0, 1, 2]
    _, new = stage.show(looking((0.0, -2.0, 1.2), (0.0, -5.0, 1.0)), rectangles=[replace(WALL, centre=(0, -5, 1.25))])
    assert new[0][0] == right[0][0] + 1  # an id that was absorbed is not given again


def test_an_ambiguous_segment_seen_once_is_dropped() -> None:
    config = changed(PlanesConfig(), candidate_keyframes=4)
    stage = Stage([WALL, FLOOR], config)
    ghost = Rectangle((0.3, 2.0, 1.2), (1, 0, 0), (0, 0, 1), (0.5, 0.5))
    seen, ids = stage.show(HERE, unreliable=(2,), rectangles=[WALL, FLOOR, ghost])
    assert ids[2] == [-1]
    assert stage.registry.candidate_count == 1
    assert len(seen.created) == 2
    stage.show(HERE)  # sees the wall through it
    assert stage.registry.candidate_count == 0
    assert len(stage.registry.instances) == 2


def test_an_ambiguous_segment_that_nothing_confirms_expires() -> None:
    stage = Stage([WALL, FLOOR], changed(PlanesConfig(), candidate_keyframes=4))
    stage.show(looking((0.0, 1.0, 1.4), (0.0, 3.0, 1.4)), unreliable=(0,))
    assert stage.registry.candidate_count == 1
    for _ in range(5):
        stage.show(looking((0.0, 0.0, 1.4), (0.0, 0.5, 0.0)))
    assert stage.registry.candidate_count == 0


def test_an_ambiguous_segment_that_comes_again_is_a_plane_from_its_first_keyframe() -> None:
    stage = Stage([WALL, FLOOR], changed(PlanesConfig(), confirm_views=3))
    found = [stage.show(T_cw, unreliable=(0,)) for T_cw in wandering(3)]
    assert [ids[0] for _, ids in found[:2]] == [[-1], [-1]]
    (plane_id,) = found[2][1][0]
    assert found[2][0].created == (plane_id,)
    assert stage.registry.instances[plane_id].keyframes == [0, 1, 2]


@pytest.mark.parametrize(("turn_deg", "views"), [(0.0, 2), (12.0, 3)])
def test_what_stands_as_a_wall_needs_one_view_less(turn_deg: float, views: int) -> None:
    turn = np.deg2rad(turn_deg)
    along = (-np.sin(turn), np.cos(turn), 0.0)  # seen from the other side than SIDE is, to which it may be parallel
    post = Rectangle((0.2, 2.2, 1.2), along, (0, 0, 1), (0.4, 0.8))
    stage = Stage([WALL, FLOOR, SIDE, post], changed(PlanesConfig(), confirm_views=3))
    poses = [looking((x, 0.3, 1.4), (1.4, 3.0, 1.2)) for x in (0.9, 0.95, 1.0)]
    found = [stage.show(T_cw, unreliable=(3,)) for T_cw in poses]
    assert [ids[3][0] >= 0 for _, ids in found] == [view + 1 >= views for view in range(3)]


def test_a_reliable_view_confirms_an_ambiguous_segment() -> None:
    stage = Stage([WALL, FLOOR])
    stage.show(HERE, unreliable=(0,))
    seen, ids = stage.show(HERE)
    assert seen.created == (ids[0][0],)
    assert stage.registry.instances[ids[0][0]].keyframes == [0, 1]


def test_what_several_views_see_through_is_removed_and_its_id_not_used_again() -> None:
    board = Rectangle((0.3, 1.8, 1.2), (1, 0, 0), (0, 0, 1), (0.6, 0.6))
    stage = Stage([WALL, FLOOR, SIDE])
    poses = wandering(8, 0.3)
    for T_cw in poses[:3]:
        _, ids = stage.show(T_cw, rectangles=[*stage.rectangles, board])
    (gone,) = ids[3]
    removed = [stage.show(T_cw)[0].removed for T_cw in poses[3:8]]
    assert removed.count((gone,)) == 1
    assert removed[0] == removed[1] == ()  # not at the first view that speaks against it
    assert stage.registry.living(gone) == -1
    assert len(stage.registry.instances) == 3
    _, ids = stage.show(poses[0], rectangles=[*stage.rectangles, board])
    assert ids[3][0] > gone


def test_one_lost_pose_does_not_remove_the_planes() -> None:
    stage = Stage([WALL, FLOOR, SIDE, TABLES[0]])
    poses = wandering(8, 0.3)
    for T_cw in poses[:4]:
        _, ids = stage.show(T_cw)
    forward = se3_exp((0.0, 0.0, 0.0, 0.0, 0.0, 0.6))
    for T_cw in poses[4:]:
        seen, _ = stage.show(T_cw, believed=forward @ T_cw)
        assert seen.removed == ()
    _, again = stage.show(poses[3])
    assert again == ids


@pytest.mark.parametrize("seed", range(4))
def test_small_pose_errors_do_not_change_identities(seed: int) -> None:
    stage, rng = Stage([WALL, FLOOR, SIDE, TABLES[1]]), np.random.default_rng(seed)
    drift, seen = np.eye(4), set()
    for T_cw in wandering(24):
        drift = se3_exp(rng.standard_normal(6) * np.repeat([0.0007, 0.002], 3)) @ drift
        _, ids = stage.show(T_cw, believed=drift @ T_cw)
        seen |= {(label, plane_id) for label, found in ids.items() for plane_id in found}
    assert len(seen) == 4


def test_planes_follow_when_keyframes_are_moved() -> None:
    stage, wrong = Stage([WALL, FLOOR, SIDE]), {}
    for keyframe, T_cw in enumerate(wandering(10)):
        error = se3_exp(np.array([0.0, 0.0, 0.0004, 0.002, 0.004, 0.0]) * keyframe)  # T_wc is off by it
        wrong[keyframe] = error
        _, ids = stage.show(T_cw, believed=T_cw @ inverse(error))
    before = abs(stage.registry.instances[ids[0][0]].offset_m - 3.0)
    assert stage.registry.move({k: inverse(error) for k, error in wrong.items()}) == ()
    wall = stage.registry.instances[ids[0][0]]
    assert abs(wall.offset_m - 3.0) < min(0.005, before)
    assert_allclose(wall.normal_w, [0, -1, 0], atol=0.003)
    cells, _ = wall.support.cells()
    points = wall.support.centres(cells)
    assert np.abs(points[:, 1] - 3.0).max() < 0.01
    assert np.abs(points[:, 0]).max() < 2.6


def test_moving_keyframes_back_merges_what_drift_had_parted() -> None:
    stage = Stage([WALL, FLOOR])
    drift = se3_exp((0.0, 0.0, 0.0, 0.0, 0.3, 0.0))
    _, first = stage.show(HERE)
    _, second = stage.show(HERE, believed=HERE @ inverse(drift))
    assert first[0] != second[0]
    assert first[1] == second[1]  # the floor was not affected
    assert stage.registry.instances[first[0][0]].lineage.revision == 0
    assert stage.registry.move({1: inverse(drift)}) == ((first[0][0], second[0][0]),)
    assert stage.registry.instances[first[0][0]].lineage.revision == 1
    assert len(stage.registry.instances) == 2


def test_two_surfaces_that_were_taken_for_one_are_split() -> None:
    config = changed(PlanesConfig(), pose_sigma_m=0.004, step_sigma_m=0.05, max_distance_m=0.3, gate_sigmas=3.0)
    stage = Stage([WALL], config)
    near = [replace(WALL, centre=(0.0, 2.94, 1.25))]
    turns = [stage.show(HERE, rectangles=near if turn % 2 else None) for turn in range(10)]
    ids = {plane_id for _, found in turns for plane_id in found[0]}
    offsets = sorted(instance.offset_m for instance in stage.registry.instances.values())
    assert len(ids) >= 2
    assert_allclose(offsets[0], 2.94, atol=0.015)
    assert_allclose(offsets[-1], 3.0, atol=0.015)


def test_many_views_take_bounded_memory() -> None:
    stage = Stage([WALL, FLOOR], changed(PlanesConfig(), kept_views=16))
    for _ in range(3):
        for T_cw in wandering(12):
            _, ids = stage.show(T_cw)
    wall = stage.registry.instances[ids[0][0]]
    assert len(wall.keyframes) == 36
    kept = [k for k in range(36) if wall.view(k) is not None]
    assert len(kept) == 16
    assert kept[0] == 0
    assert kept[-1] == 35
    assert max(np.diff(kept)) <= 8


def test_a_view_is_as_certain_as_the_sensor_and_the_surface_that_is_asked_for() -> None:
    stage = Stage([WALL, FLOOR])
    _, ids = stage.show(HERE)
    wall = stage.registry.instances[ids[0][0]]
    exact, rough, as_set = wall.view(0, 0.0), wall.view(0, 0.01), wall.view(0)
    assert exact and rough and as_set
    assert_allclose(rough.covariance[2, 2] - exact.covariance[2, 2], 0.01**2, rtol=1e-9)
    assert_allclose(as_set.covariance, wall.view(0, PlanesConfig().expert.uncertainty.planarity_sigma_m).covariance)
    assert exact.covariance[2, 2] < 0.001**2  # thousands of pixels: the sensor's noise averages out
    assert_allclose(exact.normal, rough.normal)
    assert stage.registry.seen_from(0, 0.01)[wall.id].covariance[2, 2] == rough.covariance[2, 2]


def test_a_view_without_planes_changes_nothing() -> None:
    stage = Stage([WALL, FLOOR])
    _, ids = stage.show(HERE)
    empty, nothing = stage.show(looking((0.0, 0.0, 1.4), (0.0, -3.0, 1.4)))
    assert nothing == {}
    assert (empty.created, empty.merged, empty.removed) == ((), (), ())
    assert empty.ids.shape == (0,)
    assert sorted(stage.registry.instances) == sorted(i for found in ids.values() for i in found)


def test_the_id_image_is_that_of_the_segments() -> None:
    stage = Stage([WALL, FLOOR])
    seen, _ = stage.show(HERE)
    labels = np.array([[0, 1], [-1, 0]], np.int32)
    assert seen.id_image(labels).tolist() == [[seen.ids[0], seen.ids[1]], [-1, seen.ids[0]]]


def test_what_a_view_parts_stays_in_the_order_in_which_it_was_found() -> None:
    """Where extents overlap, the order decides; it must not be that of addresses in memory."""
    config = PlanesConfig()
    plane = PlaneEstimate(
        np.array([0.0, 0.0, -1.0]), np.asarray(2.0), np.array([0.0, 0.0, 2.0]), np.eye(3)[:2], np.eye(3)
    )
    joining = Joining(config, Tolerance.of(config, NOISE))
    owner, others = PlanarInstance(plane, config), [PlanarInstance(plane, config) for _ in range(30)]
    for other in others:
        joining.step(owner, other)
    assert joining.parted_from(owner) == others
    kept = PlanarInstance(plane, config)
    joining.replace(owner, kept)
    assert joining.parted_from(kept) == others
