"""Planes on their way out of the registry: plain data that fits the true scene, is written, and reads back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from tests.fakes import FakeSystem
from tests.plane_views import Playback
from tests.test_plane_outputs import assert_same
from tgslam.evaluation.plane_metrics import plane_errors
from tgslam.geometry import tangent_axes
from tgslam.output.planes_io import read_planes
from tgslam.output.run_folder import RunFolder
from tgslam.output.triangulation import signed_area
from tgslam.planes.identity import palette
from tgslam.planes.instances.export import planes_of
from tgslam.types import Plane


@pytest.fixture(scope="module")
def playback() -> Playback:
    """Ten keyframes of the room with segments of its true planes."""
    return Playback("room").play(range(0, 200, 20))


@pytest.fixture(scope="module")
def planes(playback: Playback) -> tuple[Plane, ...]:
    return planes_of(playback.registry)


def test_planes_are_those_of_the_registry(playback: Playback, planes: tuple[Plane, ...]) -> None:
    instances = playback.registry.instances
    assert [plane.id for plane in planes] == list(instances)
    assert len(planes) >= 5
    for plane, instance in zip(planes, instances.values(), strict=True):
        np.testing.assert_array_equal(plane.normal_w, instance.normal_w)
        assert plane.normal_w @ plane.centroid_w + plane.offset_m == pytest.approx(0, abs=1e-9)
        np.testing.assert_allclose(plane.colour, palette.colours(plane.id), atol=1e-6)
        assert plane.keyframes == tuple(sorted(plane.keyframes))
        assert set(plane.keyframes) <= set(range(0, 200, 20))
        assert plane.area_m2 > 0


def test_outlines_enclose_about_the_area_and_lie_on_their_planes(planes: tuple[Plane, ...]) -> None:
    for plane in planes:
        for polygon in plane.polygons_w:
            np.testing.assert_allclose(polygon @ plane.normal_w + plane.offset_m, 0, atol=1e-9)
        areas = [signed_area(polygon @ tangent_axes(plane.normal_w).T) for polygon in plane.polygons_w]
        assert all(area > 0 for area in areas)  # counter-clockwise from the front
        if plane.area_m2 > 1:
            assert 0.8 < sum(areas) / plane.area_m2 < 2  # holes, where things hide the plane, are filled


def test_large_planes_are_close_to_the_true_ones(playback: Playback, planes: tuple[Plane, ...]) -> None:
    seen = {label: ids[-1] for label, ids in playback.ids_of_planes(1.0).items()}
    errors = plane_errors(planes, seen, playback.source.planes(), np.eye(4))
    assert errors["plane_normal_p95_deg"] < 1
    assert errors["plane_offset_mm"] < 10


def test_a_run_folder_holds_them_and_gives_them_back(planes: tuple[Plane, ...], tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", overwrite=False)
    folder.write_planes(planes, FakeSystem().gaussians())
    for one, other in zip(planes, read_planes(folder.planes), strict=True):
        assert_same(one, other)
    scene = trimesh.load(folder.planes_mesh)
    assert set(scene.graph.nodes_geometry) == {f"plane {plane.id}" for plane in planes if plane.polygons_w}
    areas = [signed_area(p @ tangent_axes(plane.normal_w).T) for plane in planes for p in plane.polygons_w]
    assert scene.area == pytest.approx(sum(areas), rel=1e-3)
