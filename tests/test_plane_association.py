"""Gating, overlap, cost and assignment of segments to PGIs; the support grid; the structure cue."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from tests.plane_views import Rectangle, Stage, looking
from tests.plane_worlds import shifted
from tests.test_plane_estimate import random_plane, random_pose
from tests.tiers import changed
from tgslam.config.plane_settings import PlanesConfig
from tgslam.geometry import inverse, so3_exp, tangent_axes, transform_points
from tgslam.keyframing.structure_cue import StructureCue
from tgslam.planes.estimate import PlaneEstimate
from tgslam.planes.instances.association import Agreement, assign, gate, matching_cost, overlap
from tgslam.planes.instances.support import Support

CONFIG = PlanesConfig()
seeds = st.integers(0, 2**32 - 1)


def plane_at(normal: tuple[float, float, float], point: tuple[float, float, float], sigma: float) -> PlaneEstimate:
    unit, centroid = np.asarray(normal) / np.linalg.norm(normal), np.asarray(point, np.float64)
    return PlaneEstimate(
        unit, np.asarray(-unit @ centroid), centroid, tangent_axes(unit), np.diag([sigma, sigma, sigma]) ** 2
    )


@given(seeds)
def test_the_gate_does_not_depend_on_the_worlds_origin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    plane = random_plane(rng)
    other = shifted(plane, 0.03 * rng.standard_normal(3))
    camera, moved = rng.uniform(-3, 3, 3), random_pose(rng)
    here = gate(plane, other, camera, CONFIG)
    there = gate(plane.transformed(moved), other.transformed(moved), transform_points(moved, camera), CONFIG)
    assert_allclose(there.angle_rad, here.angle_rad, atol=1e-6)
    assert_allclose(there.offset_ratio, here.offset_ratio, atol=1e-9)
    assert_allclose(there.deviation_sigmas, here.deviation_sigmas, rtol=1e-6)


def test_what_the_gate_lets_through() -> None:
    camera = np.array([0.0, 0.0, 2.0])
    floor = plane_at((0, 0, 1), (0, 0, 0), 0.005)
    assert gate(plane_at((0, 0, 1), (1, 0, 0.01), 0.005), floor, camera, CONFIG).admitted
    assert not gate(plane_at((0, 0, 1), (0, 0, 0.05), 0.005), floor, camera, CONFIG).admitted
    assert gate(plane_at((0, 0, 1), (0, 0, 0.05), 0.03), floor, camera, CONFIG).admitted  # less certain
    assert not gate(plane_at((0, 0, 1), (0, 0, 0.3), 0.3), floor, camera, CONFIG).admitted  # but never so far
    assert not gate(plane_at((0, 0, -1), (0, 0, 0), 0.005), floor, camera, CONFIG).admitted  # its other side
    assert not gate(plane_at((0.3, 0, 1), (0, 0, 0), 0.3), floor, camera, CONFIG).admitted


def test_a_plane_through_the_camera_has_a_finite_offset_ratio() -> None:
    shelf = plane_at((0, 0, 1), (1, 0, 1.999), 0.005)
    agreement = gate(plane_at((0, 0, 1), (1, 0, 2.001), 0.005), shelf, np.array([0.0, 0.0, 2.0]), CONFIG)
    assert agreement.admitted
    assert agreement.offset_ratio < 0.01


def test_overlap_counts_samples() -> None:
    labels = np.array([0, 0, 0, 1, 1, -1])
    masks = overlap(labels, 2, [np.array([0, 1]), np.array([2, 3, 4, 5]), np.array([], int)])
    assert masks.intersection.tolist() == [[2, 1, 0], [0, 2, 0]]
    assert_allclose(masks.iou, [[2 / 3, 1 / 6, 0], [0, 2 / 4, 0]])
    assert_allclose(masks.containment, [[1, 1 / 3, 0], [0, 1, 0]])


def test_the_cost_is_equation_7() -> None:
    config = changed(PlanesConfig(), matching_weights=(2.0, 3.0, 5.0), max_angle_rad=0.1, max_offset_ratio=0.2)
    agreement = Agreement(np.array([0.05]), np.array([0.1]), np.array([0.0]), np.array([True]))
    assert_allclose(matching_cost(agreement, np.array([0.4]), config), 2 * 0.5 + 3 * 0.5 + 5 * 0.6)


def test_the_assignment_is_optimal_where_the_nearest_is_ambiguous() -> None:
    # Both rows like column 0 best; greedily row 0 would take it and leave row 1 with a bad match
    cost = np.array([[0.10, 0.15], [0.12, 0.90]])
    assert assign(cost, np.ones((2, 2), bool)) == [(0, 1), (1, 0)]
    assert assign(cost, np.array([[True, True], [False, True]])) == [(0, 0), (1, 1)]
    assert assign(cost, np.zeros((2, 2), bool)) == []
    assert assign(np.zeros((0, 3)), np.zeros((0, 3), bool)) == []


@given(seeds)
def test_no_other_assignment_costs_less(seed: int) -> None:
    cost = np.random.default_rng(seed).uniform(0, 3, (4, 5))
    total = sum(cost[i, j] for i, j in assign(cost, np.ones_like(cost, bool)))
    best = min(sum(cost[range(4), chosen]) for chosen in permutations(range(5), 4))
    assert_allclose(total, best)


def filled(size: tuple[int, int], plane: PlaneEstimate, at: tuple[int, int] = (0, 0)) -> Support:
    support = Support(plane, 0.05)
    i, j = np.meshgrid(np.arange(size[0]), np.arange(size[1]), indexing="ij")
    support.add(np.column_stack([i.ravel(), j.ravel()]) + at, 0)
    return support


def test_area_and_outline_of_a_support() -> None:
    plane = plane_at((1, 2, 3), (0.3, -1.0, 2.0), 0.01)
    support = filled((20, 40), plane, (-7, 3))
    assert_allclose(support.area_m2, 2.0)
    (polygon,) = support.polygons()
    assert_allclose(plane.heights_m(polygon), 0.0, atol=1e-9)
    along = (polygon - support.origin) @ support.axes.T
    x, y = along.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    assert_allclose(area, 2.0, rtol=0.06)  # positive: counter-clockwise seen from the front
    assert len(polygon) <= 8


def test_a_support_forgets_what_is_seen_through_and_moves_with_its_plane() -> None:
    support = filled((4, 4), plane_at((0, 0, 1), (0, 0, 0), 0.01))
    cells, _ = support.cells()
    support.add(cells[:8], 1)
    support.weaken(cells)
    assert len(support) == 8
    support.weaken(np.array([[100, 100], *cells[:8]]))
    assert len(support) == 0
    support = filled((4, 4), plane_at((0, 0, 1), (0, 0, 0), 0.01))
    tilted = plane_at((0.1, 0, 1), (0, 0, 0.2), 0.01)
    support.follow(tilted)
    assert_allclose(tilted.heights_m(support.centres(cells)), 0.0, atol=1e-9)
    assert_allclose(support.axes @ support.axes.T, np.eye(2), atol=1e-12)


def test_near_cells_have_no_more_than_the_gap_between_them() -> None:
    support = filled((2, 2), plane_at((0, 0, 1), (0, 0, 0), 0.01))
    beside = np.array([[2, 0], [3, 0], [4, 0], [-3, 1], [-4, 1]])
    assert support.near(beside, 0.1).tolist() == [True, True, True, True, False]
    assert support.near(beside, 0.0).tolist() == [True, False, False, False, False]


def test_a_row_of_single_cells_has_an_outline():
    support = Support(plane_at((0, 0, 1), (0, 0, 0), 0.01), 0.05)
    support.add(np.column_stack([np.arange(12), np.zeros(12, int)]), keyframe=0)
    (polygon,) = support.polygons()
    assert len(polygon) >= 3


def test_a_huge_support_gets_coarser_cells_and_keeps_its_area() -> None:
    support = Support(plane_at((0, 0, 1), (0, 0, 0), 0.01), 0.05)
    for start in range(0, 3000, 100):
        i, j = np.meshgrid(np.arange(100) + round(start * 0.05 / support.cell_m), np.arange(8), indexing="ij")
        support.add(np.column_stack([i.ravel(), j.ravel()]), start)
    assert max(support._evidence.shape) <= 1024
    assert support.cell_m > 0.05


def corner_stage() -> Stage:
    """Floor and two walls that meet in a corner at (2, 2)."""
    return Stage(
        [
            Rectangle((0, 0, 0), (1, 0, 0), (0, 1, 0), (4, 4)),
            Rectangle((2, 0, 1.25), (0, 1, 0), (0, 0, 1), (4, 2.5)),
            Rectangle((0, 2, 1.25), (1, 0, 0), (0, 0, 1), (4, 2.5)),
        ]
    )


@pytest.fixture
def corner() -> tuple[StructureCue, np.ndarray]:
    """A cue that has seen the corner, and the camera's pose."""
    stage, T_cw = corner_stage(), looking((-1.0, -1.0, 1.4), (1.5, 1.5, 0.6))
    stage.show(T_cw)
    cue = StructureCue(changed(PlanesConfig(), cue_angle_rad=0.2, cue_distance_m=0.3, cue_ratio=0.5))
    cue.reset(stage.registry.instances.values(), T_cw)
    return cue, T_cw


def test_the_structure_cue_is_silent_where_little_changes(corner: tuple[StructureCue, np.ndarray]) -> None:
    cue, T_cw = corner
    assert cue.cue(T_cw) == ""
    assert cue.cue(looking((-0.9, -1.1, 1.4), (1.5, 1.5, 0.6))) == ""
    assert cue.cue(looking((-0.65, -1.0, 1.4), (1.85, 1.5, 0.6))) == ""  # nearer to one wall only


def test_the_structure_cue_fires_with_figures(corner: tuple[StructureCue, np.ndarray]) -> None:
    cue, T_cw = corner
    shifted = cue.cue(looking((-0.5, -0.5, 1.4), (2.0, 2.0, 0.6)))
    assert "2 of 3 planes drifted" in shifted
    assert "0.50 m" in shifted
    turn = np.eye(4)
    turn[:3, :3] = so3_exp((0.0, 0.3, 0.0))
    turned = cue.cue(turn @ T_cw)
    assert turned.startswith("structure: ")
    assert "2 in angle (up to 17.0 deg), 0 in distance" in turned
    cue.reset([], T_cw)
    assert cue.cue(turn @ T_cw) == ""


def test_the_structure_cue_agrees_with_planes_in_the_cameras_frame(corner: tuple[StructureCue, np.ndarray]) -> None:
    _, T_cw = corner
    stage = corner_stage()
    stage.show(T_cw)
    for instance in stage.registry.instances.values():
        local = instance.plane.transformed(T_cw)
        assert local.offset_m > 0  # n points to the camera
        assert_allclose(local.transformed(inverse(T_cw)).offset_m, instance.offset_m)


def test_a_strip_of_one_cell_has_an_outline() -> None:
    (polygon,) = filled((1, 12), plane_at((0, 0, 1), (0, 0, 0), 0.01)).polygons()
    assert len(polygon) >= 3


def test_parts_of_a_support_can_be_taken_from_it() -> None:
    support = filled((4, 4), plane_at((0, 0, 1), (0, 0, 0), 0.01))
    support.add(np.array([[0, 6], [1, 6], [2, 7]]), 3)  # the last one touches the others by a corner only
    kept, other = np.array([[0, 0]]), np.array([[1, 6], [0, 7]])
    assert not support.connects(kept, other)
    assert support.connects(kept, np.array([[3, 3]]))
    places, keyframes = support.take_part(np.array([[1, 6]]), kept)
    assert_allclose(support.cells_of(places), [[0, 6], [1, 6]])
    assert keyframes.tolist() == [3, 3]
    assert len(support) == 17
    assert support.remove(np.array([[2, 7], [9, 9]])) == 1
    assert len(support) == 16
