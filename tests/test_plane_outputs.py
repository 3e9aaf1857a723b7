"""What a run writes about its planes: numbers that read back, a mesh, a floor plan, a coloured map, overlays."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from plyfile import PlyData

from tgslam.errors import OutputError
from tgslam.output import overview
from tgslam.output.floorplan import IMAGE_UP_W, up_direction, wall_lines, write_floorplan
from tgslam.output.overview import Overview, draw_overview
from tgslam.output.plane_colours import in_plane_colours
from tgslam.output.plane_overlay import plane_overlay
from tgslam.output.planes_io import read_planes, write_planes
from tgslam.output.planes_mesh import write_mesh
from tgslam.output.ply import SH_C0
from tgslam.output.run_folder import RunFolder
from tgslam.output.triangulation import signed_area, triangulate
from tgslam.planes.identity import palette
from tgslam.types import Gaussians, Plane

SVG = "{http://www.w3.org/2000/svg}"
STEP = 1 / 255  # of 8-bit colours
CONCAVE = np.array([[0, 0], [3, 0], [3, 1], [1, 1], [1, 3], [0, 3]], float)  # an L of 5 square units


def plane(id_: int, corners: np.ndarray, *others: np.ndarray) -> Plane:
    """A plane through outlines [V, 3], which go counter-clockwise seen from its front."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
    normal = normal / np.linalg.norm(normal)
    red, green, blue = palette.colours(id_).tolist()
    return Plane(
        id=id_,
        normal_w=normal,
        offset_m=float(-normal @ corners[0]),
        centroid_w=corners[0] * 0.25 + corners[1] * 0.25 + corners[2] * 0.5,
        covariance=np.diag([1e-6, 2e-6, 1e-5]),
        colour=(red, green, blue),
        polygons_w=(corners, *others),
        area_m2=2.5,
        inlier_rms_m=0.004,
        keyframes=(0, 12, 30),
    )


def wall(id_: int, start: tuple[float, float], end: tuple[float, float], height: float = 2.0) -> Plane:
    """An upright rectangle over ground points (x, z), in a world whose up is -y, from y = 1 upwards."""
    (x0, z0), (x1, z1) = start, end
    low, high = 1.0, 1.0 - height
    return plane(id_, np.array([[x0, low, z0], [x1, low, z1], [x1, high, z1], [x0, high, z0]]))


FLOOR = plane(7, np.array([[-2.0, 1, 0], [2, 1, 0], [2, 1, 4], [-2, 1, 4]])[::-1])
ROOM = (wall(3, (-2, 4), (2, 4)), wall(5, (2, 4), (2, 0)), FLOOR)


def assert_same(one: Plane, other: Plane) -> None:
    for name, value in vars(one).items():
        if name == "polygons_w":
            assert len(value) == len(other.polygons_w)
            for a, b in zip(value, other.polygons_w, strict=True):
                np.testing.assert_array_equal(a, b)
        else:
            np.testing.assert_allclose(value, getattr(other, name), rtol=1e-15)


def test_planes_read_back_as_they_were(tmp_path: Path) -> None:
    write_planes(tmp_path / "planes.json", ROOM)
    back = read_planes(tmp_path / "planes.json")
    for one, other in zip(ROOM, back, strict=True):
        assert_same(one, other)
    write_planes(tmp_path / "again.json", back)
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "planes.json").read_bytes()
    values = json.loads((tmp_path / "planes.json").read_text())["planes"][0]
    assert {"id", "equation", "colour", "polygons", "area_m2", "inlier_rms_mm", "keyframes"} <= set(values)
    assert values["equation"] == [0, 0, -1, 4]
    assert values["inlier_rms_mm"] == 4
    write_planes(tmp_path / "none.json", ())
    assert read_planes(tmp_path / "none.json") == ()


def test_planes_that_are_not_finite_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="not finite"):
        write_planes(tmp_path / "planes.json", [replace(FLOOR, offset_m=float("nan"))])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("id", -1, "whole number"),
        ("id", 1.5, "whole number"),
        ("id", True, "whole number"),
        ("equation", [0, 0, 1], "shape"),
        ("equation", [0, 0, 2, 1], "unit length"),
        ("equation", [0, -1, 0, "x"], "damaged"),
        ("equation", [0, -1, 0, None], "damaged"),
        ("centroid", [0, 0, 0], "not on it"),
        ("covariance", [[1, 0], [0, 1]], "shape"),
        ("colour", [0, 0, 2], r"\[0, 1\]"),
        ("polygons", [[[0, 0, 0], [1, 0, 0]]], "fewer than 3"),
        ("polygons", [[[0, 0], [1, 0], [1, 1]]], "shape"),
        ("polygons", 3, "damaged"),
        ("area_m2", -1, "0 or more"),
        ("inlier_rms_mm", None, "0 or more"),
        ("keyframes", ["a"], "whole number"),
    ],
)
def test_a_damaged_plane_is_an_error_that_says_where(tmp_path: Path, key: str, value: object, expected: str) -> None:
    path = tmp_path / "planes.json"
    write_planes(path, [FLOOR])
    values = json.loads(path.read_text())
    values["planes"][0][key] = value
    path.write_text(json.dumps(values))
    with pytest.raises(OutputError, match=expected) as caught:
        read_planes(path)
    assert str(path) in str(caught.value)
    del values["planes"][0][key]
    path.write_text(json.dumps(values))
    with pytest.raises(OutputError, match=f"number 0 has no '{key}'"):
        read_planes(path)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"planes": {}}', '{"planes": [3]}', '{"planes": [{', "\xff"])
def test_a_damaged_file_is_an_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "planes.json").write_text(text, encoding="latin-1")
    with pytest.raises(OutputError, match=r"planes\.json"):
        read_planes(tmp_path / "planes.json")
    with pytest.raises(OutputError, match="cannot be read"):
        read_planes(tmp_path / "gone.json")


def test_two_planes_of_one_id_are_an_error(tmp_path: Path) -> None:
    write_planes(tmp_path / "planes.json", [FLOOR, FLOOR])
    with pytest.raises(OutputError, match="same id"):
        read_planes(tmp_path / "planes.json")


def triangle_areas(polygon: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    return np.array([signed_area(polygon[list(corners)]) for corners in triangles])


@pytest.mark.parametrize("polygon", [CONCAVE, CONCAVE[::-1], CONCAVE @ [[0, 1], [1, 0]], CONCAVE[:3]])
def test_triangles_fill_a_polygon(polygon: np.ndarray) -> None:
    triangles = triangulate(polygon)
    areas = triangle_areas(polygon, triangles)
    assert len(triangles) == len(polygon) - 2
    assert areas.sum() == pytest.approx(signed_area(polygon))
    assert (np.sign(areas) == np.sign(signed_area(polygon))).all()


@given(st.lists(st.floats(0.1, 2.0), min_size=3, max_size=30), st.booleans())
def test_triangles_of_stars_do_not_overlap(radii: list[float], clockwise: bool) -> None:
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    polygon = np.array(radii)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    polygon = polygon[::-1] if clockwise else polygon
    areas = triangle_areas(polygon, triangulate(polygon))
    assert np.abs(areas).sum() == pytest.approx(abs(signed_area(polygon)))


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=3, max_size=12))
def test_any_outline_keeps_its_area(corners: list[tuple[int, int]]) -> None:
    polygon = np.array(corners, float)
    assert triangle_areas(polygon, triangulate(polygon)).sum() == pytest.approx(signed_area(polygon))


def test_the_mesh_reads_back_with_its_areas_and_colours(tmp_path: Path) -> None:
    shelf = np.column_stack([CONCAVE[:, 0], np.full(6, -1.0), CONCAVE[:, 1]])[::-1]
    planes = (*ROOM, plane(11, shelf, shelf + np.array([10, 0, 0])), replace(FLOOR, id=12, polygons_w=()))
    write_mesh(tmp_path / "planes.glb", planes)
    scene = trimesh.load(tmp_path / "planes.glb")
    assert set(scene.graph.nodes_geometry) == {"plane 3", "plane 5", "plane 7", "plane 11"}
    for one, area in zip(planes, (8, 8, 16, 10), strict=False):
        transform, name = scene.graph[f"plane {one.id}"]
        mesh = scene.geometry[name]
        np.testing.assert_array_equal(transform, np.eye(4))
        assert mesh.area == pytest.approx(area)
        np.testing.assert_allclose(mesh.face_normals, np.tile(one.normal_w, (len(mesh.faces), 1)), atol=1e-6)
        np.testing.assert_allclose(mesh.vertices @ one.normal_w, -one.offset_m, atol=1e-6)
        material = mesh.visual.material
        assert material.doubleSided
        linear = np.array(material.baseColorFactor[:3]) / 255
        srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        np.testing.assert_allclose(srgb, one.colour, atol=0.03)  # 8 bits a channel are coarse where it is dark


def segments(path: Path) -> dict[str, np.ndarray]:
    """Ids in order of the lines, and their ends [2, 2] m in plan axes up to a shift."""
    root = ElementTree.parse(path).getroot()
    found = {}
    for line in root.iter(f"{SVG}line"):
        if line.attrib["class"] != "wall":
            continue
        name = line.find(f"{SVG}title").text
        ends = [
            [float(line.attrib["x1"]), -float(line.attrib["y1"])],
            [float(line.attrib["x2"]), -float(line.attrib["y2"])],
        ]
        found[name] = np.array(ends) / 100
    return found


def test_the_floor_plan_has_the_walls_and_a_scale(tmp_path: Path) -> None:
    write_floorplan(tmp_path / "floorplan.svg", ROOM)
    root = ElementTree.parse(tmp_path / "floorplan.svg").getroot()
    found = segments(tmp_path / "floorplan.svg")
    assert list(found) == ["plane 3, 2.50 m2", "plane 5, 2.50 m2"]
    back, right = found.values()
    np.testing.assert_allclose(np.sort(np.ptp(back, axis=0)), [0, 4], atol=0.01)
    np.testing.assert_allclose(np.sort(np.ptp(right, axis=0)), [0, 4], atol=0.01)
    np.testing.assert_allclose(back[:, 1], right[:, 1].max(), atol=0.01)  # ahead is up on the page
    np.testing.assert_allclose(right[:, 0], back[:, 0].max(), atol=0.01)  # and right is right
    texts = [text.text for text in root.iter(f"{SVG}text")]
    assert texts == ["3", "5", "1 m"]
    (bar,) = root.iter(f"{SVG}path")
    left, end = (
        float(word[1:].split()[0]) for word in (bar.attrib["d"], bar.attrib["d"][bar.attrib["d"].index("H") :])
    )
    assert end - left == pytest.approx(100)
    _, _, width, height = (float(value) for value in root.attrib["viewBox"].split())
    assert (width, height) == (pytest.approx(520), pytest.approx(520))


def test_a_floor_plan_without_walls_is_an_image_too(tmp_path: Path) -> None:
    write_floorplan(tmp_path / "floorplan.svg", [FLOOR])
    assert segments(tmp_path / "floorplan.svg") == {}


@given(st.floats(-0.7, 0.7), st.floats(-0.6, 0.6), st.floats(-3, 3))
def test_up_is_found_for_a_tilted_first_camera(pitch: float, roll: float, yaw: float) -> None:
    (a, b), (c, d), (e, f) = ((np.cos(x), np.sin(x)) for x in (pitch, roll, yaw))
    turn = np.array([[1, 0, 0], [0, a, -b], [0, b, a]]) @ np.array([[c, -d, 0], [d, c, 0], [0, 0, 1]])
    turn = turn @ np.array([[e, 0, f], [0, 1, 0], [-f, 0, e]])
    if (turn @ IMAGE_UP_W) @ IMAGE_UP_W < np.cos(np.deg2rad(40)):
        return
    planes = [turned(one, turn) for one in ROOM]
    up = up_direction(planes)
    np.testing.assert_allclose(up, turn @ IMAGE_UP_W, atol=1e-9)
    lengths = [np.linalg.norm(np.diff(line.ends_m, axis=0)) for line in wall_lines(planes, up)]
    np.testing.assert_allclose(lengths, [4, 4], atol=1e-9)


def turned(one: Plane, R: np.ndarray) -> Plane:
    polygons = tuple(polygon @ R.T for polygon in one.polygons_w)
    return replace(one, normal_w=R @ one.normal_w, centroid_w=R @ one.centroid_w, polygons_w=polygons)


def test_up_falls_back_to_the_first_image() -> None:
    np.testing.assert_array_equal(up_direction(()), IMAGE_UP_W)
    np.testing.assert_array_equal(up_direction(ROOM[:2]), IMAGE_UP_W)
    ramp = turned(replace(FLOOR, area_m2=0.5), np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]))
    np.testing.assert_allclose(up_direction([ramp, *ROOM]), IMAGE_UP_W, atol=1e-12)
    ceiling = replace(FLOOR, normal_w=-FLOOR.normal_w)
    np.testing.assert_allclose(up_direction([ceiling]), IMAGE_UP_W, atol=1e-12)


def some_gaussians() -> Gaussians:
    count = 3
    return Gaussians(
        mean=np.zeros((count, 3), np.float32),
        log_scale=np.zeros((count, 3), np.float32),
        quat_wxyz=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        opacity_logit=np.zeros(count, np.float32),
        colour=np.array([[1, 0, 0], [0, 1, 0], [1, 1, 1]], np.float32),
        embedding=np.zeros((count, 3), np.float32),
        plane_id=np.array([3, 8, -1], np.int32),
        birth_keyframe=np.zeros(count, np.int32),
    )


def test_the_map_in_plane_colours_is_a_map_for_viewers(tmp_path: Path) -> None:
    gaussians = some_gaussians()
    coloured = in_plane_colours(gaussians, ROOM)
    np.testing.assert_allclose(coloured.colour[0], ROOM[0].colour)
    np.testing.assert_allclose(coloured.colour[1], 0.5 * 0.587, rtol=1e-6)  # its plane is not among them
    np.testing.assert_allclose(coloured.colour[2], 0.5, rtol=1e-6)
    folder = RunFolder(tmp_path)
    folder.write_planes(ROOM, gaussians)
    names = {"planes.json", "planes.glb", "floorplan.svg", "map_planes.ply"}
    assert {path.name for path in tmp_path.iterdir()} == names <= set(RunFolder.RESULTS)
    vertices = PlyData.read(str(folder.map_planes))["vertex"]
    stored = np.stack([vertices[f"f_dc_{k}"] for k in range(3)], axis=1) * SH_C0 + 0.5
    np.testing.assert_allclose(stored, coloured.colour, atol=1e-6)


def test_without_planes_there_is_nothing_to_show(tmp_path: Path) -> None:
    RunFolder(tmp_path).write_planes((), some_gaussians())
    assert [path.name for path in tmp_path.iterdir()] == ["planes.json"]


def test_the_overlay_blends_colours_and_lists_what_is_there() -> None:
    colour = np.full((120, 160, 3), 0.25, np.float32)
    ids = np.full((120, 160), -1, np.int32)
    ids[20:60, 30:120] = 3
    ids[90:93, 3:6] = 99  # no plane of the run
    image = plane_overlay(colour, ids, ROOM)
    assert image.shape[0] == 120
    assert image.shape[1] > 160
    assert image.dtype == np.float32
    assert 0 <= image.min() <= image.max() <= 1
    np.testing.assert_allclose(image[50, 40], 0.125 + 0.5 * np.array(ROOM[0].colour), atol=STEP)
    np.testing.assert_allclose(image[:15, :160], 0.25, atol=STEP)
    np.testing.assert_allclose(image[91, 4], 0.25, atol=STEP)
    assert image[30:50, 35:115].min(axis=-1).max() > 0.8  # the id, in white
    assert image[30:50, 35:115].max(axis=-1).min() < 0.2  # on black
    legend = image[:, 160:]
    assert np.isclose(legend, np.float32(ROOM[0].colour), atol=STEP).all(axis=-1).any()
    assert not np.isclose(legend, np.float32(ROOM[1].colour), atol=STEP).all(axis=-1).any()
    empty = plane_overlay(colour, np.full_like(ids, -1), ROOM)
    np.testing.assert_allclose(empty[:, :160], colour, atol=STEP)


def an_overview(planes: list[Plane], width: int = 160, height: int = 120) -> Overview:
    ids = np.full((height, width), -1, np.int32)
    ids[height // 4 : height // 2, width // 4 : width // 2] = 3
    return Overview(
        title="input",
        colour=np.full((height, width, 3), 0.25, np.float32),
        rendering=np.full((height, width, 3), 1.5, np.float32),
        ids=ids,
        planes=planes,
        T_wc=np.eye(4),
        centres_w=np.array([[0.0, 0, 0], [0, 0, 1], [1, 0, 2]]),
        half_width=0.7,
    )


def panels(picture: np.ndarray) -> list[np.ndarray]:
    """The four panels: 10 px lie between them and round them, and 26 above them for captions."""
    height, width = picture.shape[0] // 2 - 36, (picture.shape[1] - 30) // 2
    corners = [(26 + y, 10 + x) for y in (0, height + 36) for x in (0, width + 10)]
    return [picture[top : top + height, left : left + width] for top, left in corners]


@pytest.mark.parametrize(("width", "height"), [(160, 120), (1280, 960)])
def test_the_overview_has_input_rendering_planes_and_floor_plan(width: int, height: int) -> None:
    picture = draw_overview(an_overview(ROOM, width, height))
    assert picture.dtype == np.float32
    assert 0 <= picture.min() <= picture.max() <= 1
    given_image, rendering, planes, plan = panels(picture)
    np.testing.assert_allclose(given_image, 0.25, atol=0.02)
    np.testing.assert_array_equal(rendering, 1)
    rows, columns = planes.shape[:2]
    blended = 0.5 + 0.5 * np.array(ROOM[0].colour)
    np.testing.assert_allclose(planes[int(0.27 * rows), int(0.27 * columns)], blended, atol=0.02)
    np.testing.assert_array_equal(planes[int(0.6 * rows) :], 1)
    for wall_plane in (ROOM[0], ROOM[1]):
        assert np.isclose(plan, np.float32(wall_plane.colour), atol=0.02).all(axis=-1).sum() > 200
    red = (plan[..., 0] > 0.7) & (plan[..., 1] < 0.2) & (plan[..., 2] < 0.2)
    assert red.sum() > 50  # the path


def test_the_overview_of_a_camera_that_stands_still_before_a_floor() -> None:
    view = replace(an_overview([FLOOR]), centres_w=np.zeros((1, 3)))
    plan = panels(draw_overview(view))[3]
    rows, columns = np.nonzero((plan[..., 0] > 0.7) & (plan[..., 1] < 0.2))
    assert len(rows) > 20  # a dot
    assert abs(float(columns.mean()) - plan.shape[1] / 2) < 2
    assert abs(float(rows.mean()) - plan.shape[0] / 2) < 20


def test_ids_on_the_floor_plan_never_stand_on_one_another(monkeypatch: pytest.MonkeyPatch) -> None:
    printed: list[tuple[str, tuple[int, int]]] = []
    monkeypatch.setattr(overview, "print_text", lambda image, text, middle, scale: printed.append((text, middle)))
    draw_overview(an_overview([wall(id_, (-2.0, 4.0), (2.0, 4.0)) for id_ in range(40, 49)]))
    assert [text for text, _ in printed] == ["40", "41", "42", "43", "44"]  # as many as there are places
    assert len({middle for _, middle in printed}) == 5
