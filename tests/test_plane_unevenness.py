"""A surface that buckles is one instance: what stands off it a little, in its midst, goes by its id."""

from __future__ import annotations

import numpy as np
import pytest

from tests.plane_views import Rectangle, Stage, looking
from tests.tiers import changed
from tgslam.config.plane_settings import PlanesConfig, SegmentationSettings
from tgslam.planes.estimate import PlaneEstimate
from tgslam.planes.instances.instance import PlanarInstance
from tgslam.planes.instances.unevenness import is_part

WALL = Rectangle((0.0, 2.0, 1.25), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (3.0, 2.5))
VIEWS = [looking((x, 0.5, 1.2), (x + 0.1, 2.0, 1.2)) for x in np.linspace(-0.3, 0.3, 6)]


def standing_off(distance_m: float, size: tuple[float, float] = (0.3, 0.6), height_m: float = 1.2) -> Rectangle:
    return Rectangle((0.0, 2.0 - distance_m, height_m), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), size)


def instance(plane_id: int, rectangle: Rectangle, turn_rad: float = 0.0, of_m: float = 0.05) -> PlanarInstance:
    """Seen all over, by one keyframe; turned about the vertical."""
    normal = np.array([np.sin(turn_rad), -np.cos(turn_rad), 0.0])
    centre = np.array(rectangle.centre)
    axes = np.stack([np.cross([0.0, 0.0, 1.0], normal), [0.0, 0.0, 1.0]])
    plane = PlaneEstimate(normal, np.asarray(-normal @ centre), centre, axes, np.eye(3) * 1e-8)
    made = PlanarInstance(plane, changed(PlanesConfig(), extent_cell_m=of_m))
    made.id = plane_id
    counts = [round(side / of_m) for side in rectangle.size]
    made.support.add(np.argwhere(np.ones(counts)) - np.array(counts) // 2, 0)
    return made


@pytest.mark.parametrize(
    ("small", "turn_rad", "expected"),
    [
        (standing_off(0.006), 0.0, True),
        (standing_off(-0.006), 0.0, True),  # a dent
        (standing_off(0.006), 0.03, True),
        (standing_off(0.015), 0.0, False),
        (standing_off(0.006), 0.1, False),
        (standing_off(0.006, (2.0, 0.1), 0.05), 0.0, False),  # a skirting board
        (standing_off(0.006, (2.0, 2.0)), 0.0, False),  # as large as the wall
    ],
)
def test_what_is_a_part(small: Rectangle, turn_rad: float, expected: bool) -> None:
    wall, other = instance(0, WALL), instance(1, small, turn_rad)
    cells, _ = other.support.cells()
    wall.support.remove(np.unique(wall.support.cells_of(other.support.centres(cells)), axis=0))
    assert is_part(other, wall, SegmentationSettings()) is expected
    assert not is_part(wall, other, SegmentationSettings())
    assert not is_part(wall, wall, SegmentationSettings())


def test_a_candidate_has_no_parts() -> None:
    assert not is_part(instance(1, standing_off(0.006)), instance(-1, WALL), SegmentationSettings())


# Segments of truly exact planes, which the registry then tells apart at less than a centimetre
TOLD_APART = changed(PlanesConfig(), planarity_sigma_m=0.0002)


def test_a_buckle_goes_by_its_surfaces_id() -> None:
    stage = Stage([WALL, standing_off(0.008)], TOLD_APART)
    for T_cw in VIEWS:
        _, ids = stage.show(T_cw)
        assert ids[0] == ids[1]
    assert list(stage.registry.instances) == ids[0]
    assert stage.registry.candidate_count == 0
    assert abs(stage.registry.instances[ids[0][0]].offset_m - 2.0) < 0.002  # its plane is not the buckle's


def test_a_board_keeps_its_own_id() -> None:
    stage = Stage([WALL, standing_off(0.015)], TOLD_APART)
    for T_cw in VIEWS:
        _, ids = stage.show(T_cw)
        assert ids[0] != ids[1]
    assert len(stage.registry.instances) == 2


def test_an_instance_that_turns_out_to_be_a_part_gives_up_its_id() -> None:
    """A view close up shows nothing around it."""
    stage = Stage([WALL, standing_off(0.008)], TOLD_APART)
    _, near = stage.show(looking((0.0, 1.7, 1.2), (0.0, 2.0, 1.2)))
    (part,) = near[1]
    for T_cw in VIEWS:
        _, ids = stage.show(T_cw)
    assert ids[0] == ids[1] != [part]
    assert stage.registry.living(part) == ids[0][0]


def test_a_part_of_what_is_no_more_counts_again() -> None:
    stage = Stage([WALL, standing_off(0.008)], TOLD_APART)
    for T_cw in VIEWS:
        stage.show(T_cw)
    for _ in range(2 * TOLD_APART.expert.lifetime.through_keyframes):  # the wall has gone, which the view sees through
        for T_cw in VIEWS:
            _, ids = stage.show(T_cw, rectangles=[standing_off(-1.0, (4.0, 4.0)), standing_off(0.008)])
    (part,) = ids[1]
    assert part >= 0
    assert part != ids[0][0]
    assert part in stage.registry.instances
