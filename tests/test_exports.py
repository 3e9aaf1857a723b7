"""`tgslam export`: each format, read by an independent reader or by one written here from the format's description."""

from __future__ import annotations

import gzip
import json
import logging
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from plyfile import PlyData
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tests.fakes import CAMERA, FakeSource, FakeSystem, true_pose
from tgslam.cli import engine, inputs, main
from tgslam.config.schema import Config
from tgslam.exports.export_formats import FORMATS
from tgslam.exports.levelling import level_transform
from tgslam.exports.moved import moved_gaussians, moved_planes
from tgslam.exports.run_content import RunContent
from tgslam.exports.sparse_cloud import sparse_cloud
from tgslam.geometry import inverse, matrix_from_quat_wxyz, se3_exp, tangent_axes, transform_points
from tgslam.output.log import FrameLog
from tgslam.output.planes_io import read_planes
from tgslam.output.ply import SH_C0, read_map
from tgslam.output.run_folder import RunFolder, RunRecord, RunState
from tgslam.output.run_results import write_results
from tgslam.types import Gaussians, Plane

FRAMES = 7  # of which every third is a keyframe
LOST = 4
KEYFRAMES = (0, 3, 6)
COUNT = 300  # Gaussians: more than a chunk of the compressed PLY
TILT = se3_exp([np.deg2rad(20.0), 0.0, np.deg2rad(5.0), 0.0, 0.0, 0.0])  # of the first camera in a level room
EYE_M = 1.5  # above the floor


def some_gaussians() -> Gaussians:
    rng = np.random.default_rng(1)
    return Gaussians(
        mean=rng.uniform([-2, -1, 1], [2, EYE_M, 4], (COUNT, 3)).astype(np.float32),
        log_scale=rng.uniform(-6.0, -1.0, (COUNT, 3)).astype(np.float32),
        quat_wxyz=rng.normal(size=(COUNT, 4)).astype(np.float32),
        opacity_logit=rng.uniform(-4.0, 4.0, COUNT).astype(np.float32),
        colour=rng.uniform(0.0, 1.0, (COUNT, 3)).astype(np.float32),
        embedding=np.zeros((COUNT, 3), np.float32),
        plane_id=np.full(COUNT, -1, np.int32),
        birth_keyframe=np.zeros(COUNT, np.int32),
    )


def plane(number: int, normal: list[float], centre: list[float], size_m: float) -> Plane:
    """A square whose sides lie along the tangents of its normal."""
    n, c = np.array(normal), np.array(centre)
    corners = c + 0.5 * size_m * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ tangent_axes(n)
    covariance = np.diag([1e-6, 4e-6, 9e-6])
    return Plane(number, n, -float(n @ c), c, covariance, (1.0, 0.5, 0.0), (corners,), size_m**2, 0.003, (0,))


def room_planes() -> tuple[Plane, ...]:
    """Floor, table and a wall ahead, as the tilted first camera sees them."""
    level = (
        plane(1, [0, -1, 0], [0, EYE_M, 2], 3.0),
        plane(2, [0, -1, 0], [0.5, 0.8, 2], 1.0),
        plane(3, [0, 0, -1], [0, 0.2, 4], 2.0),
        plane(4, [0, -1, 0], [1, 2.0, 2], 0.1),  # a small thing that came out too low
    )
    return moved_planes(level, TILT)


class FoundRun(FakeSystem):
    """What the run has found."""

    def gaussians(self) -> Gaussians:
        return some_gaussians()

    def planes(self) -> tuple[Plane, ...]:
        return room_planes()


def make_run(path: Path, found: FakeSystem | None = None) -> RunFolder:
    """A run folder with all its files, without SLAM."""
    system, source = found or FoundRun(lost=(LOST,)), FakeSource(FRAMES)
    folder = RunFolder.create(path, overwrite=False)
    folder.write_config(Config())
    with FrameLog(folder.log) as log:
        for index in range(FRAMES):
            log.append(system.process_frame(source.read(index)))
    write_results(folder, system)
    folder.write_record(RunRecord("0.1.0", RunState.FINISHED, "fake", None, (None, None, None), CAMERA))
    return folder


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that is made once, and copied for each test."""
    return make_run(tmp_path_factory.mktemp("made") / "run").path


@pytest.fixture
def run(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunFolder]:
    """A run in a folder of a name that is not ASCII, and the input that it was made from."""
    monkeypatch.setattr(inputs, "open_source", lambda *args: FakeSource(FRAMES))
    monkeypatch.setattr(engine, "start_device", lambda name, threads=0: "cpu")
    logger = logging.getLogger("tgslam")
    before = list(logger.handlers), logger.level, logger.propagate
    shutil.copytree(made, tmp_path / "Küche 1")
    yield RunFolder(tmp_path / "Küche 1")
    logger.handlers[:], logger.level, logger.propagate = before


def export(run: RunFolder, name: str, *options: str) -> Path:
    """What the command wrote."""
    assert main(["export", str(run.path), "--to", name, *options]) == 0
    return run.path / "exports" / FORMATS[name].file


def refused(capsys: pytest.CaptureFixture[str], run: RunFolder, *options: str) -> str:
    """The one line that the command fails with."""
    capsys.readouterr()
    assert main(["export", str(run.path), *options]) == 1
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "error:" in line)
    return line


def assert_same(read: dict[str, np.ndarray], tolerances: dict[str, float], T: np.ndarray | None = None) -> None:
    """Gaussians in any order are those of the run, seen from the frame T; a rotation errs by an angle in rad.

    Half a turn about an axis of its own makes no other Gaussian.
    """
    wanted = some_gaussians()
    T = np.eye(4) if T is None else T
    distance, order = cKDTree(read["mean"]).query(transform_points(T, wanted.mean))
    assert len(read["mean"]) == COUNT == len(set(order))
    assert distance.max() < tolerances["mean"]
    for name, values in (
        ("log_scale", wanted.log_scale),
        ("opacity", 1.0 / (1.0 + np.exp(-wanted.opacity_logit))),
        ("colour", wanted.colour),
    ):
        np.testing.assert_allclose(read[name][order], values, rtol=0, atol=tolerances[name], err_msg=name)
    R = T[:3, :3] @ matrix_from_quat_wxyz(wanted.quat_wxyz)
    turned = matrix_from_quat_wxyz(read["quat"][order]).swapaxes(1, 2) @ R
    halves = [np.diag(signs) for signs in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]
    angles = np.min([Rotation.from_matrix(turned @ half).magnitude() for half in halves], axis=0)
    assert angles.max() < tolerances["quat"]


EXACT = {"mean": 1e-5, "log_scale": 1e-6, "opacity": 1e-6, "colour": 1e-6, "quat": 1e-5}


def read_ply(path: Path) -> dict[str, np.ndarray]:
    rows = PlyData.read(path)["vertex"]

    def columns(*names: str) -> np.ndarray:
        return np.column_stack([rows[name] for name in names]).astype(np.float64)

    return {
        "mean": columns("x", "y", "z"),
        "log_scale": columns("scale_0", "scale_1", "scale_2"),
        "opacity": 1.0 / (1.0 + np.exp(-columns("opacity")[:, 0])),
        "colour": SH_C0 * columns("f_dc_0", "f_dc_1", "f_dc_2") + 0.5,
        "quat": columns("rot_0", "rot_1", "rot_2", "rot_3"),
    }


def read_splat(path: Path) -> dict[str, np.ndarray]:
    data = np.frombuffer(path.read_bytes(), np.uint8).reshape(-1, 32)
    floats = data[:, :24].copy().view("<f4")
    return {
        "mean": floats[:, :3],
        "log_scale": np.log(floats[:, 3:]),
        "colour": data[:, 24:27] / 255.0,
        "opacity": data[:, 27] / 255.0,
        "quat": (data[:, 28:].astype(np.float64) - 128.0) / 128.0,
    }


def read_spz(path: Path) -> dict[str, np.ndarray]:
    """In its own world: right, up, back."""
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<IIIBBBB", data[:16])
    assert (magic, version, degree, flags, reserved) == (0x5053474E, 2, 0, 0, 0)
    assert len(data) == 16 + 19 * count
    raw = np.frombuffer(data, np.uint8, offset=16).astype(np.int64)
    parts = np.split(raw, np.cumsum([9 * count, count, 3 * count, 3 * count]))
    places = parts[0].reshape(-1, 3, 3) @ [1, 1 << 8, 1 << 16]
    xyz = parts[4].reshape(-1, 3) / 127.5 - 1.0
    w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1)))
    return {
        "mean": np.where(places >= 1 << 23, places - (1 << 24), places) / 2.0**bits,
        "opacity": parts[1] / 255.0,
        "colour": SH_C0 * (parts[2].reshape(-1, 3) / 255.0 - 0.5) / 0.15 + 0.5,
        "log_scale": parts[3].reshape(-1, 3) / 16.0 - 10.0,
        "quat": np.column_stack([w, xyz]),
    }


def read_packed_ply(path: Path) -> dict[str, np.ndarray]:
    ply = PlyData.read(path)
    assert [element.name for element in ply.elements] == ["chunk", "vertex"]
    boxes, rows = ply["chunk"], ply["vertex"]
    chunk = np.arange(len(rows)) // 256
    assert len(boxes) == chunk[-1] + 1

    def between(names: tuple[str, ...], ways: np.ndarray) -> np.ndarray:
        low, high = (np.column_stack([boxes[f"{end}_{name}"] for name in names])[chunk] for end in ("min", "max"))
        return low + ways * (high.astype(np.float64) - low)

    def thirds(packed: np.ndarray) -> np.ndarray:
        return np.column_stack([(packed >> 21) / 2047, (packed >> 11 & 1023) / 1023, (packed & 2047) / 2047])

    rotation = np.asarray(rows["packed_rotation"])
    others = (np.column_stack([rotation >> at & 1023 for at in (20, 10, 0)]) / 1023 - 0.5) * np.sqrt(2.0)
    quat = np.zeros((len(rows), 4))
    for row, largest in enumerate(rotation >> 30):
        quat[row] = np.insert(others[row], int(largest), np.sqrt(1.0 - (others[row] ** 2).sum()))
    rgba = np.column_stack([np.asarray(rows["packed_color"]) >> at & 255 for at in (24, 16, 8, 0)]) / 255
    return {
        "mean": between(("x", "y", "z"), thirds(np.asarray(rows["packed_position"]))),
        "log_scale": between(("scale_x", "scale_y", "scale_z"), thirds(np.asarray(rows["packed_scale"]))),
        "colour": between(("r", "g", "b"), rgba[:, :3]),
        "opacity": rgba[:, 3],
        "quat": quat,
    }


def test_a_ply_is_the_map(run: RunFolder) -> None:
    path = export(run, "ply")
    assert_same(read_ply(path), EXACT)
    np.testing.assert_array_equal(read_map(path).mean, read_map(run.map).mean)
    assert not path.with_name("map_extra.npz").exists()


def test_a_splat_file_has_large_gaussians_first(run: RunFolder) -> None:
    read = read_splat(export(run, "splat"))
    assert_same(read, {"mean": 1e-6, "log_scale": 1e-5, "opacity": 0.51 / 255, "colour": 0.51 / 255, "quat": 0.02})
    weight = read["log_scale"].sum(axis=1) + np.log(np.maximum(read["opacity"], 1e-3))
    assert weight[:50].min() > weight[-50:].max()


@pytest.mark.parametrize("level", [False, True])
def test_an_spz_file_has_y_upwards(run: RunFolder, level: bool) -> None:
    read = read_spz(export(run, "spz", *["--level"] * level))
    if level:
        T_lw = RunContent(run, FakeSource, level=True).T_lw
        upright = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]) @ T_lw
    else:
        upright = np.diag([1.0, -1.0, -1.0, 1.0])
    steps = {"mean": 2**-12, "log_scale": 0.51 / 16, "opacity": 0.51 / 255, "colour": 0.51 / 255 * SH_C0 / 0.15}
    assert_same(read, {**steps, "quat": 0.03}, upright)


def test_a_compressed_ply_keeps_chunks_small(run: RunFolder) -> None:
    path = export(run, "compressed-ply")
    step = 0.51 / 1023  # of the box
    steps = {"mean": 4.0 * step, "log_scale": 5.0 * step, "opacity": 0.51 / 255, "colour": 0.51 / 255, "quat": 0.005}
    assert_same(read_packed_ply(path), steps)


def test_far_gaussians_fit_into_an_spz_file(run: RunFolder, tmp_path: Path) -> None:
    from tgslam.exports.spz import write_spz

    far = moved_gaussians(some_gaussians(), se3_exp([0, 0, 0, 5000.0, 0, 0]))
    write_spz(tmp_path / "far.spz", far, level=False)
    np.testing.assert_allclose(read_spz(tmp_path / "far.spz")["mean"][:, 0], far.mean[:, 0], atol=2**-10)


@pytest.mark.parametrize("name", ["ply", "splat", "spz", "compressed-ply"])
def test_a_map_without_gaussians_is_a_file_without_gaussians(run: RunFolder, name: str) -> None:
    class Empty(FoundRun):
        def gaussians(self) -> Gaussians:
            return Gaussians(**{key: value[:0] for key, value in vars(some_gaussians()).items()})

    assert export(make_run(run.path.parent / "empty", Empty()), name, "--level").exists()


def test_a_level_world_has_the_floor_at_zero(run: RunFolder) -> None:
    T_lc = RunContent(run, FakeSource, level=True).T_lw
    up = T_lc[:3, :3] @ TILT[:3, :3] @ [0, -1, 0]
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(T_lc[:3, 3], [0, 0, EYE_M], atol=1e-9)
    assert (T_lc @ TILT)[1, 2] > 0.99  # y is ahead
    assert_same(read_ply(export(run, "ply", "--level")), EXACT, T_lc)
    floor, table, wall, _ = read_planes(export(run, "planes", "--level"))
    np.testing.assert_allclose([*floor.normal_w, floor.offset_m], [0, 0, 1, 0], atol=1e-9)
    assert table.centroid_w[2] == pytest.approx(EYE_M - 0.8)
    assert abs(wall.normal_w[2]) < 1e-9
    assert transform_points(T_lc, room_planes()[2].polygons_w[0]) == pytest.approx(wall.polygons_w[0])


def test_a_level_world_follows_the_first_camera_and_needs_no_planes() -> None:
    T_wc = se3_exp([0.3, 1.0, -0.4, 3.0, 2.0, 1.0])  # poses that were known: the world is not the first camera's
    seen, seen_by = moved_planes(room_planes(), T_wc), moved_gaussians(some_gaussians(), T_wc)
    there, here = level_transform(seen, seen_by, T_wc), level_transform(room_planes(), some_gaussians(), np.eye(4))
    np.testing.assert_allclose(there @ T_wc, here, atol=1e-6)
    alone = level_transform((), some_gaussians(), np.eye(4))
    heights = transform_points(alone, some_gaussians().mean)[:, 2]
    assert (heights < 0).mean() == pytest.approx(0.01, abs=0.005)


def test_the_covariance_of_a_plane_turns_with_it() -> None:
    T = se3_exp([0.5, -1.0, 2.0, 1.0, 2.0, 3.0])
    before = plane(0, [0.0, 0.6, -0.8], [1, 2, 3], 1.0)
    (after,) = moved_planes([before], T)
    directions = [
        (tangent_axes(p.normal_w).T @ p.covariance[:2, :2] @ tangent_axes(p.normal_w)) for p in (before, after)
    ]
    np.testing.assert_allclose(directions[1], T[:3, :3] @ directions[0] @ T[:3, :3].T, atol=1e-15)
    assert float(after.normal_w @ after.centroid_w) + after.offset_m == pytest.approx(0.0, abs=1e-12)


def known_frames() -> list[int]:
    return [index for index in range(FRAMES) if index != LOST]


def read_colmap_text(folder: Path) -> tuple[list[str], dict[str, np.ndarray], np.ndarray]:
    def lines(name: str) -> list[str]:
        return [x for x in (folder / "sparse/0" / name).read_text().splitlines() if not x.startswith("#")]

    (camera,) = lines("cameras.txt")
    rows = lines("images.txt")
    assert set(rows[1::2]) == {""}
    poses = {}
    for words in (row.split() for row in rows[::2]):
        assert words[8] == camera.split()[0]
        poses[words[9]] = np.array(words[1:8], float)
    return camera.split()[1:], poses, np.array([x.split() for x in lines("points3D.txt")], float)


def read_colmap_binary(folder: Path) -> tuple[list[str], dict[str, np.ndarray], np.ndarray]:
    data = (folder / "sparse/0/cameras.bin").read_bytes()
    count, camera_id, model, width, height, *values = struct.unpack("<QiiQQdddd", data)
    assert (count, model) == (1, 1)
    camera = ["PINHOLE", str(width), str(height), *map(repr, values)]
    data, poses = (folder / "sparse/0/images.bin").read_bytes(), {}
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        _, *pose, camera_of_image = struct.unpack_from("<idddddddi", data, at)
        assert camera_of_image == camera_id
        end = data.index(b"\0", at + 64)
        poses[data[at + 64 : end].decode()] = np.array(pose)
        assert struct.unpack_from("<Q", data, end + 1) == (0,)
        at = end + 9
    assert at == len(data)
    data, points = (folder / "sparse/0/points3D.bin").read_bytes(), []
    (count,) = struct.unpack_from("<Q", data)
    for row in range(count):
        *point, track = struct.unpack_from("<QdddBBBdQ", data, 8 + 51 * row)
        assert track == 0
        points.append(point)
    assert len(data) == 8 + 51 * count
    return camera, poses, np.array(points)


@pytest.mark.parametrize(("name", "read"), [("colmap", read_colmap_binary), ("colmap-text", read_colmap_text)])
def test_a_colmap_model_has_the_cameras_and_a_cloud(run: RunFolder, name: str, read) -> None:
    folder = export(run, name)
    camera, poses, points = read(folder)
    assert camera[:3] == ["PINHOLE", str(CAMERA.width), str(CAMERA.height)]
    assert [float(x) for x in camera[3:]] == [CAMERA.fx, CAMERA.fy, CAMERA.cx + 0.5, CAMERA.cy + 0.5]
    assert len(poses) == len(KEYFRAMES)
    for (image, pose), index in zip(sorted(poses.items()), KEYFRAMES, strict=True):
        T_cw = inverse(true_pose(index))
        np.testing.assert_allclose(matrix_from_quat_wxyz(pose[:4]), T_cw[:3, :3], atol=1e-6)
        np.testing.assert_allclose(pose[4:], T_cw[:3, 3], atol=1e-6)
        assert cv2.imread(str(folder / "images" / image)).shape == (CAMERA.height, CAMERA.width, 3)
    opaque = some_gaussians().opacity_logit >= 0
    np.testing.assert_allclose(points[:, 1:4], some_gaussians().mean[opaque], rtol=1e-6)
    np.testing.assert_allclose(points[:, 4:7], 255 * some_gaussians().colour[opaque], atol=0.51)
    assert set(points[:, 7]) == {-1.0}


def test_every_frame_that_was_tracked_is_exported_on_request(run: RunFolder, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(read_colmap_binary(export(run, "colmap", "--every-frame"))[1]) == len(known_frames())
    monkeypatch.setattr(inputs, "open_source", lambda *args: FakeSource(FRAMES, bad=(0, 3)))
    index = json.loads((export(run, "nerfstudio") / "transforms.json").read_text())
    assert [frame["timestamp"] for frame in index["frames"]] == [pytest.approx(0.6)]


def test_a_nerfstudio_folder_is_whole(run: RunFolder) -> None:
    folder = export(run, "nerfstudio", "--level")
    index = json.loads((folder / "transforms.json").read_text())
    assert (index["w"], index["h"], index["fl_x"], index["cx"]) == (CAMERA.width, CAMERA.height, CAMERA.fx, 12.0)
    T_lw = RunContent(run, FakeSource, level=True).T_lw
    assert len(index["frames"]) == len(KEYFRAMES)
    for frame, number in zip(index["frames"], KEYFRAMES, strict=True):
        wanted = T_lw @ true_pose(number) @ np.diag([1, -1, -1, 1])  # OpenGL's camera looks along -z
        np.testing.assert_allclose(frame["transform_matrix"], wanted, atol=1e-6)
        assert cv2.imread(str(folder / frame["file_path"])) is not None
        depth = cv2.imread(str(folder / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
        assert depth[0, 0] * index["depth_unit_scale_factor"] == pytest.approx(2.0)
    cloud = PlyData.read(folder / index["ply_file_path"])["vertex"]
    points = np.column_stack([cloud[axis] for axis in "xyz"])
    opaque = some_gaussians().opacity_logit >= 0
    np.testing.assert_allclose(points, transform_points(T_lw, some_gaussians().mean[opaque]), atol=1e-5)
    np.testing.assert_allclose(cloud["red"], 255 * some_gaussians().colour[opaque, 0], atol=0.51)


def test_a_cloud_is_thinned_the_same_each_time() -> None:
    thin = [sparse_cloud(some_gaussians(), most=20) for _ in range(2)]
    assert len(thin[0].points_w) == 20 == len(np.unique(thin[0].points_w, axis=0))
    np.testing.assert_array_equal(thin[0].points_w, thin[1].points_w)


def test_evo_reads_the_poses(run: RunFolder) -> None:
    from evo.tools import file_interface  # slow to import, and one test needs it

    truth = np.stack([true_pose(index) for index in range(FRAMES)])
    tum = file_interface.read_tum_trajectory_file(str(export(run, "tum")))
    np.testing.assert_allclose(np.stack(tum.poses_se3), truth, atol=1e-8)
    np.testing.assert_allclose(tum.timestamps, 0.1 * np.arange(FRAMES), atol=1e-6)
    kitti = file_interface.read_kitti_poses_file(str(export(run, "kitti")))
    np.testing.assert_allclose(np.stack(kitti.poses_se3), truth, atol=1e-8)


def test_trimesh_reads_the_planes(run: RunFolder) -> None:
    scene = trimesh.load(export(run, "glb", "--level"))
    assert set(scene.graph.nodes_geometry) == {f"plane {number}" for number in (1, 2, 3, 4)}
    assert scene.geometry["plane 1"].vertices[:, 2] == pytest.approx(0.0, abs=1e-6)


def test_a_floor_plan_is_drawn_in_metres(run: RunFolder) -> None:
    assert b"<svg" in export(run, "svg").read_bytes()
    lines = export(run, "dxf", "--level").read_text().splitlines()
    tags = list(zip(map(int, lines[::2]), lines[1::2], strict=True))
    assert tags[-1] == (0, "EOF")
    assert [value for code, value in tags if code == 0].count("SECTION") == 3 == tags.count((0, "ENDSEC"))
    assert tags[tags.index((9, "$INSUNITS")) + 1] == (70, "6")
    defined = {tags[at + 1][1] for at, tag in enumerate(tags) if tag == (0, "LAYER")}
    first = tags.index((2, "ENTITIES"))
    assert {value for code, value in tags[first:] if code == 8} == defined
    line, text = tags.index((0, "LINE"), first), tags.index((0, "TEXT"), first)
    ends = {code: float(value) for code, value in tags[line + 2 : text]}
    assert np.hypot(ends[11] - ends[10], ends[21] - ends[20]) == pytest.approx(2.0, abs=1e-5)
    assert dict(tags[text + 1 : text + 7])[1] == "3"


def test_nothing_is_overwritten_without_being_asked(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("spz", "colmap"):
        path = export(run, name)
        assert "add --overwrite" in refused(capsys, run, "--to", name)
        assert export(run, name, "--overwrite") == path
    mine = run.path / "mine"
    mine.write_text("mine")
    assert "colmap is a folder" in refused(capsys, run, "--to", "colmap", "--output", str(mine), "--overwrite")
    assert "ply is a file" in refused(capsys, run, "--to", "ply", "--output", str(run.path), "--overwrite")
    assert mine.read_text() == "mine"
    before = run.map.read_bytes()
    own = ["--output", str(run.path / "exports" / ".." / "map.ply"), "--level", "--overwrite"]
    assert "the run's own" in refused(capsys, run, "--to", "ply", *own)
    assert run.map.read_bytes() == before
    assert {path.name for path in (run.path / "exports").iterdir()} == {"map.spz", "colmap"}


def test_a_model_in_text_takes_the_place_of_a_binary_one(run: RunFolder) -> None:
    target = ["--output", str(run.path / "model")]
    export(run, "colmap", *target)
    export(run, "colmap-text", *target, "--overwrite")
    names = {path.name for path in (run.path / "model" / "sparse" / "0").iterdir()}
    assert names == {"cameras.txt", "images.txt", "points3D.txt"}


def test_a_run_that_was_cut_off_gives_what_it_has(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    run.map.rename(run.partial_map)
    run.trajectory.rename(run.partial_trajectory)
    run.planes.unlink()
    assert_same(read_ply(export(run, "ply")), EXACT)
    assert "cut off" in capsys.readouterr().err
    assert export(run, "kitti").exists()
    assert export(run, "planes").exists()
    for name, message in (("glb", "no planes"), ("svg", "no planes"), ("dxf", "no planes")):
        assert message in refused(capsys, run, "--to", name)
    run.partial_map.unlink()
    assert "neither map.ply nor partial_map.ply" in refused(capsys, run, "--to", "splat")


def test_a_run_without_readable_images_has_none_to_export(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(inputs, "open_source", lambda *args: FakeSource(FRAMES, bad=tuple(range(FRAMES))))
    assert "no image" in refused(capsys, run, "--to", "colmap")
    assert not (run.path / "exports/colmap/sparse/0/images.bin").exists()
    assert "not a run folder" in refused(capsys, RunFolder(run.path / "gone"), "--to", "ply")
