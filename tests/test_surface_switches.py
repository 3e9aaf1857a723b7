"""Identity switches without labels, where the surfaces and what becomes of their ids are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from tests.fakes import FakeSource
from tests.plane_views import Rectangle, cast, looking
from tests.reference import patches as reference
from tgslam.camera import Camera
from tgslam.errors import FrameError
from tgslam.evaluation.held_out import view_metrics
from tgslam.evaluation.panoptic import IdentitySwitches, overlaps, shown
from tgslam.evaluation.patches import patches_of
from tgslam.evaluation.surface_switches import SURFACE_KEY, SurfaceSwitches
from tgslam.geometry import inverse
from tgslam.types import Frame, Rendering

CAMERA = Camera(160, 120, 120.0, 120.0, 79.5, 59.5)
WALL = Rectangle((0.0, 2.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (4.0, 2.0))
FLOOR = Rectangle((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (4.0, 4.0))
TOPS = [Rectangle((x, 1.0, 0.7), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.7, 0.7)) for x in (-0.4, 0.4)]
SCENE = [WALL, FLOOR, *TOPS]
SIGMA_PER_M2 = 0.0015
Names = Callable[[int, np.ndarray], np.ndarray]  # what becomes of the labels [H, W] of a frame


def path(frames: int) -> list[np.ndarray]:
    """T_cw of a camera that goes along the wall and back, looking at it from the side, tables and floor in view."""
    swings = np.sin(np.linspace(0.0, 2 * np.pi, frames))
    return [looking((1.2 * s, -1.0, 1.5), (0.3 * s, 1.4, 0.6)) for s in swings]


def switches(
    names: Names, poses: Sequence[np.ndarray], scene: Sequence[Rectangle] = SCENE, noise: bool = True
) -> tuple[int, int]:
    """The switches that are counted without labels, and those with labels, over renamed labels."""
    rng, blind, told = np.random.default_rng(3), SurfaceSwitches(CAMERA), IdentitySwitches()
    for frame, T_cw in enumerate(poses):
        depth_m, labels = cast(list(scene), CAMERA, T_cw)
        ids = names(frame, labels.astype(np.int32))
        sigma_m = SIGMA_PER_M2 * depth_m**2 if noise else 0.0 * depth_m
        measured = (depth_m + sigma_m * rng.standard_normal(depth_m.shape)).astype(np.float32)
        blind.add(measured, ids, inverse(T_cw))
        found = overlaps(labels.astype(np.int32), ids)
        told.add(found, shown(found)[0])
    assert blind.frames == len(poses)
    return blind.switches, told.switches


def renamed(labels: np.ndarray, names: dict[int, int]) -> np.ndarray:
    result = labels.copy()
    for label, id_ in names.items():
        result[labels == label] = id_
    return result


def test_ids_that_stay_do_not_switch() -> None:
    assert switches(lambda _, labels: labels, path(20)) == (0, 0)


@pytest.mark.parametrize("label", range(len(SCENE)))
def test_a_plane_that_changes_its_id_and_back_switches_twice(label: int) -> None:
    def names(frame: int, labels: np.ndarray) -> np.ndarray:
        return renamed(labels, {label: 9} if frame in (7, 8, 9) else {})

    assert switches(names, path(20)) == (2, 2)


def test_two_planes_that_swap_their_ids_switch_both() -> None:
    assert switches(lambda frame, labels: renamed(labels, {2: 3, 3: 2} if frame >= 10 else {}), path(20)) == (2, 2)


def test_a_plane_that_becomes_part_of_another_one_switches_and_the_other_one_does_not() -> None:
    assert switches(lambda frame, labels: renamed(labels, {2: 0} if frame >= 10 else {}), path(20)) == (1, 1)


def test_a_plane_that_parts_from_another_one_switches() -> None:
    assert switches(lambda frame, labels: renamed(labels, {2: 0} if frame < 10 else {}), path(20)) == (1, 1)


def test_a_plane_that_falls_into_two_switches_once_however_labels_see_it() -> None:
    def names(frame: int, labels: np.ndarray) -> np.ndarray:
        ids = labels.copy()
        ids[:, : CAMERA.width // 2][(labels == 0)[:, : CAMERA.width // 2]] = 9 if frame >= 5 else 0
        return ids

    still = [looking((0.0, -1.0, 1.2), (0.0, 2.0, 1.0))] * 10
    assert switches(names, still)[0] == 1


def test_what_is_not_read_for_a_while_keeps_its_id() -> None:
    assert switches(lambda frame, labels: renamed(labels, {0: -1} if 5 <= frame < 15 else {}), path(20)) == (0, 0)
    blind, told = switches(
        lambda frame, labels: renamed(labels, {0: -1} if 5 <= frame < 15 else {0: 9} if frame >= 15 else {}), path(20)
    )
    assert blind == told == 1


def test_ragged_borders_and_specks_are_no_switches() -> None:
    rng = np.random.default_rng(0)

    def names(frame: int, labels: np.ndarray) -> np.ndarray:
        shift = rng.integers(-2, 3, 2)
        ids = np.roll(labels, shift, (0, 1))
        ids[rng.random(ids.shape) < 0.05] = 8
        ids[40:44, 40:44] = 9 + frame  # less than 1/500 of the image
        return ids

    assert switches(names, path(20)) == (0, 0)


def test_the_sides_of_a_thin_wall_are_two_surfaces() -> None:
    thin = [Rectangle((0.0, y, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (2.0, 2.0)) for y in (0.0, 0.02)]
    round_it = [looking((1.9 * np.sin(a), 1.9 * np.cos(a), 1.4), (0.0, 0.0, 1.0)) for a in np.linspace(0.2, 9.2, 30)]
    assert switches(lambda _, labels: labels, round_it, thin, noise=False) == (0, 0)
    assert switches(lambda frame, labels: renamed(labels, {0: 1, 1: 0} if frame >= 15 else {}), round_it, thin) == (
        2,
        2,
    )


def test_patches_tell_the_area_that_they_show() -> None:
    T_cw = looking((0.3, 0.2, 1.0), (0.0, 2.0, 1.0))
    depth_m, labels = cast([WALL], CAMERA, T_cw)
    patches = patches_of(depth_m, labels.astype(np.int32), CAMERA, inverse(T_cw))
    corners = np.array([[u, v, 1.0] for u, v in ((-0.5, -0.5), (159.5, -0.5), (159.5, 119.5), (-0.5, 119.5))])
    rays = (corners - (CAMERA.cx, CAMERA.cy, 0.0)) / (CAMERA.fx, CAMERA.fy, 1.0) @ inverse(T_cw)[:3, :3].T
    on_wall = rays * (1.8 / rays[:, 1:2])
    inside = np.clip(on_wall + np.array([0.3, 0.2, 1.0]), (-2.0, 2.0, 0.0), (2.0, 2.0, 2.0))
    x, z = inside[:, 0], inside[:, 2]
    expected = 0.5 * abs(float(np.sum(x * np.roll(z, -1) - np.roll(x, -1) * z)))
    assert patches.areas_m2.sum() == pytest.approx(expected, rel=0.05)
    assert (np.diff(patches.keys) > 0).all()
    assert set(patches.ids.tolist()) == {0}


@pytest.mark.parametrize("seed", range(3))
def test_patches_are_their_definition(seed: int) -> None:
    rng, T_cw = np.random.default_rng(seed), looking((0.4 - 0.3 * seed, -1.0, 1.5), (0.3, 1.4, 0.6))
    depth_m, labels = cast(SCENE, CAMERA, T_cw)
    depth_m = (depth_m + SIGMA_PER_M2 * depth_m**2 * rng.standard_normal(depth_m.shape)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.1] = 0.0
    ids = np.where(rng.random(depth_m.shape) < 0.15, -1, labels).astype(np.int32)
    expected = reference.patches_of(depth_m, ids, CAMERA, inverse(T_cw))
    found = patches_of(depth_m, ids, CAMERA, inverse(T_cw))
    *cube, face = (found.keys >> 41, found.keys >> 22 & (1 << 19) - 1, found.keys >> 3 & (1 << 19) - 1, found.keys & 7)
    places = [tuple(place) for place in np.stack([*(axis - (1 << 18) for axis in cube), face], axis=1).tolist()]
    assert set(places) == set(expected) and len(places) > 100
    assert found.ids.tolist() == [expected[place][0] for place in places]
    assert found.pixels.tolist() == [expected[place][1] for place in places]
    assert found.areas_m2 == pytest.approx([expected[place][2] for place in places])


def test_nothing_measured_is_no_surface() -> None:
    counter = SurfaceSwitches(CAMERA)
    assert counter.per_100_frames is None
    nothing = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    for id_ in (0, 1):
        counter.add(nothing, np.full(nothing.shape, id_, np.int32), np.eye(4))
    assert counter.per_100_frames == 0


class Torn(FakeSource):
    """A source that shows the wall, but for frame 2, which cannot be read."""

    @property
    def camera(self) -> Camera:
        return CAMERA

    def read(self, index: int) -> Frame:
        if index == 2:
            raise FrameError("frame 2 is torn")
        depth_m = np.full((CAMERA.height, CAMERA.width), 2.05, np.float32)
        return Frame(index, float(index), np.zeros((*depth_m.shape, 3), np.float32), depth_m)


def test_metrics_of_a_source_leave_out_what_cannot_be_read_and_stop_on_request() -> None:
    poses = [(i, np.eye(4)) for i in range(6)]
    image = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    rendering = Rendering(np.zeros((*image.shape, 3), np.float32), image, image)
    seen = iter((4, 4, 6, 6, 4))

    def changing(T_cw):
        return rendering, np.full(image.shape, next(seen), np.int32)

    def constant(T_cw):
        return rendering, np.full(image.shape, 4, np.int32)

    def without_planes(T_cw):
        return rendering, None

    assert view_metrics(Torn(6), poses, changing)[SURFACE_KEY] == pytest.approx(100.0 * 2 / 5)
    assert view_metrics(Torn(6), poses, constant)[SURFACE_KEY] == 0
    assert view_metrics(Torn(6), poses, without_planes)[SURFACE_KEY] is None
    assert view_metrics(Torn(6), poses, constant, stop_requested=lambda: True)[SURFACE_KEY] is None
