"""Pixels that lie on a PGI where it is known to be; worlds aligned by whole poses."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from tests.plane_views import NOISE, Rectangle, Stage, cast, looking, points_c
from tgslam.config.plane_settings import PlanesConfig
from tgslam.errors import EvaluationError
from tgslam.evaluation.trajectory import align_poses
from tgslam.geometry import inverse, se3_exp, transform_points
from tgslam.mapping.extents import KnownExtents
from tgslam.types import Trajectory

WALL = Rectangle((0.0, 3.0, 1.25), (1, 0, 0), (0, 0, 1), (3.0, 2.5))
ROWS = [Rectangle((0.0, 2.8, z), (1, 0, 0), (0, 0, 1), (0.8, 0.3)) for z in (0.9, 1.3)]
BOX = Rectangle((0.5, 2.9, 1.6), (1, 0, 0), (0, 0, 1), (0.4, 0.3))
HERE = looking((0.1, 1.0, 1.3), (0.0, 3.0, 1.1))


def extents(stage: Stage, depth_m: np.ndarray) -> KnownExtents:
    rays = points_c(stage.camera, np.ones(depth_m.shape))
    return KnownExtents(stage.registry.instances, depth_m, rays, HERE, PlanesConfig(), NOISE)


def test_pixels_without_a_segment_are_those_of_the_plane_they_lie_on() -> None:
    stage = Stage([WALL])
    _, ids = stage.show(HERE)
    depth_m, labels = cast([WALL, BOX], stage.camera, HERE)
    depth_m[:10] = 0.0
    found = extents(stage, depth_m).completed(np.full(labels.shape, -1, np.int32))
    wall = (labels == 0) & (depth_m > 0)
    assert np.mean(found[wall] == ids[0][0]) > 0.97
    assert (found[~wall] == -1).all()  # the box stands 10 cm before it; nothing is known of what was not measured


def test_a_segment_over_two_parted_surfaces_is_divided() -> None:
    stage = Stage([*ROWS, WALL])
    _, ids = stage.show(HERE)
    depth_m, labels = cast([*ROWS, WALL], stage.camera, HERE)
    (first,), (second,) = ids[0], ids[1]
    taken_for_one = np.where(labels <= 1, np.int32(first), np.int32(-1))
    found = extents(stage, depth_m).divided(taken_for_one, first, stage.registry.parted_from(first))
    assert np.mean(found[labels == 0] == first) > 0.97
    assert np.mean(found[labels == 1] == second) > 0.85


def test_worlds_are_aligned_by_where_cameras_look() -> None:
    rng = np.random.default_rng(3)
    times = np.arange(20) * 0.1
    truth = np.stack([se3_exp(np.append(0.3 * rng.standard_normal(3), [0.001 * i, 0.0, 0.0])) for i in range(20)])
    world = se3_exp((0.4, -0.2, 0.7, 1.0, 2.0, -0.5))
    noise = np.stack([se3_exp(rng.standard_normal(6) * np.repeat([0.0005, 0.002], 3)) for _ in range(20)])
    estimate = Trajectory(times, np.linalg.inv(world) @ truth @ noise)
    T = align_poses(estimate, Trajectory(times, truth), 0.02)
    assert_allclose(T, world, atol=0.004)
    with pytest.raises(EvaluationError, match="none of 20 poses"):
        align_poses(estimate, Trajectory(times + 100.0, truth), 0.02)


def test_points_in_a_cameras_frame_lie_over_the_extent_that_they_lie_over_in_the_world() -> None:
    stage = Stage([WALL])
    _, ids = stage.show(HERE)
    support = stage.registry.instances[ids[0][0]].support
    points_w = np.random.default_rng(0).uniform((-2.0, 2.9, 0.0), (2.0, 3.1, 2.5), (2000, 3))
    found = support.shows_extent(transform_points(HERE, points_w).T, inverse(HERE))
    assert 0.05 < np.mean(found) < 0.95
    np.testing.assert_array_equal(found, support.holds(support.cells_of(points_w)))
