"""What the registry tells others of its planes: ids that live on, the table of a version, and who owns poses."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from tests.plane_views import Rectangle, Stage, looking
from tgslam.config.plane_settings import PlanesConfig
from tgslam.geometry import se3_exp
from tgslam.planes.estimate import PlaneEstimate
from tgslam.planes.instances.instance import PlanarInstance
from tgslam.planes.instances.plane_ids import PlaneIds
from tgslam.planes.instances.plane_table import PlaneTable
from tgslam.planes.instances.views import Views

WALL = Rectangle((0.0, 3.0, 1.25), (1, 0, 0), (0, 0, 1), (5.0, 2.5))
FLOOR = Rectangle((0.0, 1.5, 0.0), (1, 0, 0), (0, 1, 0), (5.0, 5.0))
HERE = looking((0.0, 0.0, 1.4), (0.3, 3.0, 0.9))


def named(count: int) -> tuple[PlaneIds, list[PlanarInstance]]:
    stage = Stage([])
    plane = PlaneEstimate(np.array([0.0, 0.0, -1.0]), np.asarray(2.0), np.zeros(3), np.eye(3)[:2], np.eye(3))
    ids, instances = PlaneIds(), [PlanarInstance(plane, stage.config) for _ in range(count)]
    assert [ids.give(instance) for instance in instances] == list(range(count))
    return ids, instances


def test_ids_live_on_through_any_number_of_merges() -> None:
    ids, _ = named(6)
    assert ids.pass_on(5, 4) == (4, 5)
    ids.pass_on(4, 1)
    ids.pass_on(3, 2)
    living = ids.resolved([0, 1])
    assert living.dtype == np.int32
    assert living.tolist() == [0, 1, -1, -1, 1, 1]  # 2, into which 3 was merged, has been removed


def test_nothing_has_been_named_at_first() -> None:
    assert PlaneIds().resolved([]).shape == (0,)
    assert_array_equal(PlaneTable.empty().resolved(np.full((2, 3), -1)), np.full((2, 3), -1))


def test_a_table_resolves_images_of_ids() -> None:
    ids, instances = named(4)
    ids.pass_on(2, 0)
    alive = {i: instances[i] for i in (0, 1)}
    table = PlaneTable.of(alive, ids.resolved(alive))
    assert_array_equal(table.planes_w[:, 3], [2.0, 2.0, 2.0, 0.0])
    assert not table.planes_w[3].any()
    found = table.resolved(np.array([[0, 2], [3, -1]], np.int16))
    assert found.dtype == np.int32
    assert found.tolist() == [[0, 0], [-1, -1]]


def test_a_table_is_that_of_its_version() -> None:
    stage = Stage([WALL, FLOOR])
    registry = stage.registry
    assert (registry.version, len(registry.table)) == (0, 0)
    stage.show(HERE)
    table = registry.table
    assert registry.version == 1
    assert registry.table is table
    registry.move({0: se3_exp((0.0, 0.0, 0.0, 0.0, 0.1, 0.0))})
    assert registry.version == 2
    (wall,) = (i for i, plane in registry.instances.items() if plane.normal_w[1] < -0.9)
    assert abs(registry.table.planes_w[wall, 3] - table.planes_w[wall, 3] - 0.1) < 1e-6


def test_poses_are_read_only() -> None:
    stage = Stage([WALL, FLOOR])
    for _ in range(3):
        stage.show(HERE)
    before = {k: T_wc.copy() for k, T_wc in stage.registry.poses.items()}
    stage.registry.follow({1: np.eye(4)})
    assert before.keys() == stage.registry.poses.keys()
    for keyframe, T_wc in stage.registry.poses.items():
        assert_array_equal(T_wc, before[keyframe])


def test_many_views_are_thinned_evenly() -> None:
    plane = PlaneEstimate(np.array([0.0, 0.0, -1.0]), np.asarray(2.0), np.zeros(3), np.eye(3)[:2], np.eye(3))
    views = Views.none()
    for keyframe in range(100):
        views = views.joined(Views.one(keyframe, plane, 1.0 + keyframe, 0.001), 20)
    assert len(views) == 20
    assert views.keyframes[0] == 0
    assert views.keyframes[-8:].tolist() == list(range(92, 100))
    assert_array_equal(views.areas_m2, 1.0 + views.keyframes)
    assert views.of(1, 0.0) is None or 1 in views.keyframes
    assert views.of(0, 0.0) is not None


def test_all_views_by_keyframe_are_those_of_each() -> None:
    rng = np.random.default_rng(0)
    views = Views.none()
    for keyframe in (2, 3, 3, 7):
        offset = np.asarray(2.0 + 0.01 * rng.random())
        plane = PlaneEstimate(np.array([0.0, 0.0, -1.0]), offset, np.array([0, 0, offset]), np.eye(3)[:2], np.eye(3))
        views = views.joined(Views.one(keyframe, plane, 0.5 + keyframe, 0.001), 20)
    found = views.by_keyframe(0.003)
    assert list(found) == [2, 3, 7]
    for keyframe, plane in found.items():
        for name, value in vars(views.of(keyframe, 0.003)).items():
            assert_array_equal(getattr(plane, name), value)
    assert views.of(4, 0.003) is None


def test_an_instance_tells_that_it_got_or_lost_views_otherwise_than_by_being_seen() -> None:
    def wall(depth_m: float) -> PlaneEstimate:
        normal, centroid = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, depth_m])
        return PlaneEstimate(normal, np.asarray(depth_m), centroid, np.eye(3)[:2], 1e-6 * np.eye(3))

    poses = {keyframe: np.eye(4) for keyframe in range(12)}
    instance = PlanarInstance(wall(2.0), PlanesConfig())
    for keyframe in poses:
        instance.add_view(keyframe, wall(2.2 if keyframe % 2 else 2.0), 1.0, 0.001, poses)
    assert instance.lineage.revision == 0
    other = instance.split(poses)
    assert other is not None
    assert instance.lineage.revision == 1
    assert sorted(instance.keyframes + other.keyframes) == list(poses)
    instance.absorb(other, poses)
    assert instance.lineage.revision == 2
    assert list(instance.views(0.001)) == list(poses)
