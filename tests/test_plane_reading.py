"""Ids off renderings: they hold only on their plane, and where what is connected has been seen of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from tests.plane_views import Rectangle, cast, looking
from tests.reference import plane_reading as reference
from tgslam.camera import Camera, SensorNoise
from tgslam.config.plane_settings import StructureConfig
from tgslam.geometry import inverse
from tgslam.ops.render_images import RenderImages
from tgslam.planes.identity.codes import codes_of
from tgslam.planes.identity.outline import Outline
from tgslam.planes.identity.reading import PlaneReader
from tgslam.types import Plane

CAMERA = Camera(100, 60, 50.0, 50.0, 49.5, 29.5)
DEPTH_M = np.full((60, 100), 2.0, np.float32)
WALL = Rectangle((0.0, 2.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (4.0, 2.0))
FLOOR = Rectangle((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (4.0, 4.0))
TABLE = Rectangle((0.4, 1.0, 0.7), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.7, 0.7))
NAMES = (3, 21, 8)  # their ids


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


def half_seen(rectangle: Rectangle, id_: int) -> Plane:
    """The plane of a rectangle, of which the middle half has been seen."""
    along, across = (
        np.multiply(axis, size) / 2
        for axis, size in zip((rectangle.along, rectangle.across), rectangle.size, strict=True)
    )
    corners = np.array([rectangle.centre + i * along / 2 + j * across for i, j in ((-1, -1), (-1, 1), (1, 1), (1, -1))])
    *normal, offset_m = rectangle.plane
    centre = np.array(rectangle.centre)
    return Plane(id_, np.array(normal), offset_m, centre, np.eye(3), (1, 0, 0), (corners,), 1, 0, ())


@pytest.mark.parametrize("seed", range(4))
def test_reading_is_its_definition(seed: int) -> None:
    rng, config, T_cw = np.random.default_rng(seed), StructureConfig(), looking((0.2, -1.0, 1.4), (0.1, 1.5, 0.8))
    true_m, labels = cast([WALL, FLOOR, TABLE], CAMERA, T_cw)
    true_ids = np.append(NAMES, -1)[labels].astype(np.int32)
    # Ids in patches of one, a few missing or wrong, and colours that are mixtures of two planes next to their edges
    ids = np.where(rng.random(true_ids.shape) < 0.2, rng.choice([-1, *NAMES], true_ids.shape), true_ids)
    ids = np.where(ndimage.uniform_filter(rng.random(ids.shape), 5) > 0.52, -1, ids).astype(np.int32)
    opacity = rng.uniform(0.6, 1.0, ids.shape).astype(np.float32)
    share = rng.choice(np.float32([0.0, 0.3, 0.4, 0.7, 1.0]), (*ids.shape, 1))
    colours = share * codes_of(true_ids, config) + (1 - share) * codes_of(np.roll(true_ids, 3, axis=1), config)
    images = RenderImages(colours, opacity * true_m, opacity, opacity[..., None] * colours)
    depth_m = images.depth / opacity
    planes = [half_seen(rectangle, id_) for rectangle, id_ in zip((WALL, FLOOR, TABLE), NAMES, strict=True)]
    reader = PlaneReader(CAMERA, planes, config, SensorNoise(0.0015))

    def hold(ids: np.ndarray) -> np.ndarray:
        return reference.on_planes(ids, depth_m, inverse(T_cw), CAMERA, planes, config, 0.0015)

    held = reader.on_planes(ids, depth_m, T_cw)
    assert (held == hold(ids)).all() and set(np.unique(held)) == {-1, *NAMES}
    assert 0.02 < np.mean((held == -1) & (ids == true_ids)) < 0.5  # on the plane, but not where it has been seen
    mixed = reference.unmixed(held, images.embedding, opacity, config)
    assert np.mean(mixed != held) > 0.05 and np.sum(hold(mixed) != mixed) > 10
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tgslam.planes.identity.codes.read_ids", lambda *arguments: ids)
        assert (reader.read(images, T_cw) == hold(mixed)).all()
