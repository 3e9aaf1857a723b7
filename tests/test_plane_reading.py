"""Ids off renderings: they hold only on their plane, and where what is connected has been seen of it."""

from __future__ import annotations

import numpy as np
import pytest

from tgslam.camera import Camera, SensorNoise
from tgslam.config.plane_settings import StructureConfig
from tgslam.planes.identity.outline import Outline
from tgslam.planes.identity.reading import PlaneReader
from tgslam.types import Plane

CAMERA = Camera(100, 60, 50.0, 50.0, 49.5, 29.5)
DEPTH_M = np.full((60, 100), 2.0, np.float32)


def facing(*polygons: list[tuple[float, float]]) -> Plane:
    """The plane z = 2 m that faces the camera, with outlines of these corners (x, y) m."""
    outlines = tuple(np.array([(x, y, 2.0) for x, y in polygon]) for polygon in polygons)
    return Plane(
        7, np.array([0.0, 0.0, -1.0]), 2.0, np.array([0.0, 0.0, 2.0]), np.eye(3), (1, 0, 0), outlines, 1, 0, ()
    )


def square(x: float, y: float, half: float) -> list[tuple[float, float]]:
    return [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]


def test_outlines_hold_what_is_on_them_or_within_the_margin() -> None:
    outline = Outline(facing(square(0.0, 0.0, 0.5), square(0.3, 0.0, 0.5), square(3.0, 0.0, 0.2)), 0.05)
    x = np.array([0.0, 0.15, 0.79, 0.84, 0.87, -0.54, -0.57, 2.9, 2.0, 9.0, -9.0])
    held = outline.holds(np.column_stack([x, np.zeros_like(x), np.full_like(x, 2.0)]))
    assert held.tolist() == [True, True, True, True, False, True, False, True, False, False, False]


def test_a_plane_without_outlines_has_no_bounds() -> None:
    assert Outline(facing(), 0.05).holds(np.array([[9.0, 9.0, 2.0]])).all()


@pytest.mark.parametrize("depth_m", [2.0, 2.5])
def test_ids_hold_on_their_plane_and_with_what_adjoins_its_outline(depth_m: float) -> None:
    reader = PlaneReader(CAMERA, [facing(square(-1.0, 0.0, 0.4))], StructureConfig(), SensorNoise(0.0015))
    ids = np.full((60, 100), -1, np.int32)
    ids[25:35, 20:60] = 7  # from where it has been seen to 0.8 m beyond
    ids[5:10, 20:30] = 7  # where it has not
    expected = ids.copy()
    expected[5:10] = -1
    read = reader.on_planes(ids, np.where(ids == 7, np.float32(depth_m), DEPTH_M), np.eye(4))
    assert (read == (expected if depth_m == 2.0 else -1)).all()
