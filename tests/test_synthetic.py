"""The built-in scenes: exactness, determinism, paths, the sensor model and the export tool."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.reference import raycast as reference
from tgslam.camera import Camera
from tgslam.config.input_settings import DatasetConfig, SyntheticConfig
from tgslam.config.loader import load
from tgslam.conversion.playing import play
from tgslam.datasets import open_source
from tgslam.datasets.built_in import SyntheticSource
from tgslam.datasets.detection import told_format
from tgslam.datasets.live.live_source import LiveSource
from tgslam.datasets.live.stream_format import StreamReader
from tgslam.errors import ConfigError
from tgslam.geometry import inverse, matrix_from_quat_wxyz, se3_log, transform_points
from tgslam.kernels import procedural
from tgslam.synthetic import corridor, sensor
from tgslam.synthetic.ray_casting import Raycaster, camera_scene
from tgslam.synthetic.scene import Lighting, Material, SceneBuilder
from tgslam.synthetic.scenes import SCENES
from tgslam.types import Trajectory
from tools import export_synthetic

SMALL = SyntheticConfig(width=100, height=76, frames=400, noise=False)
CLOSED = [name for name, spec in SCENES.items() if spec.period_s is not None]


def source(scene: str = "room", seed: int = 0, **changes: object) -> SyntheticSource:
    return SyntheticSource(replace(SMALL, scene=scene, **changes), seed)


def points_c(camera: Camera, depth_m: np.ndarray) -> np.ndarray:
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    return rays * depth_m[..., None].astype(np.float64)


def assert_twins_agree(raycaster: Raycaster, scene, camera: Camera, T_wc: np.ndarray) -> None:
    colour, view = raycaster.render(T_wc)
    seen = camera_scene(scene, camera, T_wc)
    twin = reference.render(seen, scene.material_kind, scene.material, scene.occlusion.share, camera)
    same = (twin.primitive == view.primitive) & (twin.label == view.label)
    assert same.mean() > 0.999
    assert np.abs(twin.depth_m - view.depth_m)[same].max() < 1e-4
    assert np.abs(twin.cosine - view.cosine)[same].max() < 1e-3
    error = np.abs(twin.colour - colour).max(axis=-1)
    assert np.quantile(error, 0.998) < 1e-3  # the rest: rays that graze an edge


@pytest.mark.parametrize("scene", SCENES)
def test_kernel_agrees_with_its_numpy_twin(scene):
    one = source(scene)
    assert_twins_agree(one._raycaster, one._scene, one.camera, one.pose(330))


@pytest.mark.parametrize("kind", range(procedural.WEAVE + 1))
@pytest.mark.parametrize("scale", [0.05, 0.4])
def test_every_material_on_every_shape_agrees_with_the_twin(kind, scale):
    builder = SceneBuilder(Lighting(lamp_position_w=(0.0, 0.0, 3.0)))
    material = Material(kind, (0.7, 0.4, 0.3), (0.2, 0.3, 0.6), scale, 0.7 * scale, 0.6, 7, 0.2)
    builder.box((2.0, 0.8, 0.0), (0.8, 0.6, 0.7), material, 0.5)
    builder.ellipsoid((2.2, -0.7, 0.3), (0.3, 0.5, 0.4), material, 0.3)
    for axis in range(3):
        builder.cylinder((2.0 + 0.2 * axis, 0.0, -0.7 + 0.5 * axis), 0.18, 0.4, material, axis)
    wall = builder.quad((4.0, 0.0, 0.0), (0, -1, 0), (0, 0, 1), (3.0, 2.0), material)  # does not fill the view
    builder.quad((4.0, 0.5, 0.5), (0, -1, 0), (0, 0, 1), (0.6, 0.6), replace(material, seed=9), painted_on=wall)
    camera, scene = Camera(90, 70, 60.0, 60.0, 43.3, 35.7), builder.build()
    T_wc = np.eye(4)
    T_wc[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    assert_twins_agree(Raycaster(scene, camera), scene, camera, T_wc)
    assert (Raycaster(scene, camera).render(T_wc)[1].depth_m == 0).any()


def test_a_view_of_nothing_is_empty():
    builder = SceneBuilder()
    builder.box((0, 0, -5), (1, 1, 1), Material(procedural.PLAIN, (0.5, 0.5, 0.5)))
    colour, view = Raycaster(builder.build(), Camera(40, 30, 30.0, 30.0, 19.5, 14.5)).render(np.eye(4))
    assert not view.depth_m.any() and (view.label == -1).all() and np.ptp(colour[..., 0]) == 0


@pytest.mark.parametrize("scene", SCENES)
def test_depth_lies_on_the_labelled_planes(scene):
    one = source(scene)
    planes = one.planes()
    np.testing.assert_allclose(np.linalg.norm(planes[:, :3], axis=1), 1.0, atol=1e-12)
    for index in (0, 170, 399):
        T_wc, label = one.pose(index), one.labels(index)
        depth_m = one.clean(index).depth_m
        on_plane = (label >= 0) & (depth_m > 0)
        points_w = transform_points(T_wc, points_c(one.camera, depth_m))[on_plane]
        plane = planes[label[on_plane]]
        distance_m = np.abs((plane[:, :3] * points_w).sum(axis=1) + plane[:, 3])
        assert on_plane.mean() > 0.5 and distance_m.max() < 1e-4
        towards = (plane[:, :3] * (T_wc[:3, 3] - points_w)).sum(axis=1)
        assert (towards > -1e-4).all()  # normals point out of the solid, to where the camera is


def test_labels_and_areas_are_those_of_the_frame_that_is_asked_for() -> None:
    def source() -> SyntheticSource:
        return SyntheticSource(SyntheticConfig(frames=60, width=32, height=24), seed=0)

    used = source()
    for index in (5, 40, 40, 12):
        read = used.read((index + 20) % 60 if index == 12 else index)
        assert (used.labels(index) == source().labels(index)).all()
        assert (used.seen_areas_m2(index) == source().seen_areas_m2(index)).all()
        used.labels(index)[:] = -7  # what is given away is the caller's
        assert (used.labels(index) == source().labels(index)).all()
        assert (read.depth_m == source().read(read.index).depth_m).all()
    assert (source().labels(5) != source().labels(40)).any()


def test_frames_agree_with_each_other_through_the_exact_poses():
    one = source(width=200, height=150)
    first, second = one.clean(100), one.clean(112)
    T_21 = inverse(one.pose(112)) @ one.pose(100)
    points_2 = transform_points(T_21, points_c(one.camera, first.depth_m)).reshape(-1, 3)
    u = points_2[:, 0] / points_2[:, 2] * one.camera.fx + one.camera.cx
    v = points_2[:, 1] / points_2[:, 2] * one.camera.fy + one.camera.cy
    inside = (u > 1) & (u < one.camera.width - 2) & (v > 1) & (v < one.camera.height - 2) & (points_2[:, 2] > 0)
    maps = [x[inside].astype(np.float32)[None] for x in (u, v)]
    seen_m = cv2.remap(second.depth_m, *maps, cv2.INTER_NEAREST)[0]
    close = np.abs(seen_m - points_2[inside, 2]) < 0.02
    assert inside.mean() > 0.7 and close.mean() > 0.93  # the rest is occluded
    colour = cv2.remap(second.colour, *maps, cv2.INTER_LINEAR)[0]
    difference = np.abs(colour - first.colour.reshape(-1, 3)[inside]).max(axis=1)
    assert np.median(difference[close]) < 0.02


def test_same_seed_gives_the_same_bytes_in_any_order():
    changes = {"noise": True, "exposure_change": 0.2, "motion_blur": 2}
    one, two, other = source(**changes), source(**changes), source(seed=1, **changes)
    forward = [one.read(i) for i in (3, 4, 5)]
    backward = [two.read(i) for i in (5, 4, 3)][::-1]
    for a, b in zip(forward, backward, strict=True):
        assert a.colour.tobytes() == b.colour.tobytes() and a.depth_m.tobytes() == b.depth_m.tobytes()
    assert forward[0].depth_m.tobytes() != forward[1].depth_m.tobytes()
    assert forward[0].depth_m.tobytes() != other.read(3).depth_m.tobytes()


def test_more_frames_play_the_same_path_further():
    for scene in SCENES:
        short, long = source(scene, frames=10), source(scene, frames=4000)
        np.testing.assert_allclose(short.pose(9), long.pose(9), atol=1e-12)
        assert np.array_equal(short.clean(9).depth_m > 0, long.clean(9).depth_m > 0)
        assert long.clean(3999).depth_m.min() > 0.15  # the camera stands in the open


@pytest.mark.parametrize("distance_m", [1.0, 2.0, 3.5])
def test_depth_noise_has_the_stated_sigma(distance_m):
    rng = np.random.default_rng(3)
    rows = np.linspace(0.97, 1.03, 240, dtype=np.float32)[:, None] * distance_m
    exact_m = np.broadcast_to(rows, (240, 320)).copy()  # a slope, so that rounding is not always the same
    noisy_m = sensor.noisy_depth(exact_m, np.ones_like(exact_m), rng)
    assert (noisy_m > 0).all()
    error = (noisy_m - exact_m) / (sensor.DEPTH_SIGMA_PER_M2 * exact_m**2)
    assert abs(float(error.std()) - 1.0) < 0.15
    assert abs(float(error.mean())) < 0.05


def test_holes_at_edges_grazing_angles_and_out_of_range():
    rng = np.random.default_rng(5)
    depth_m = np.full((60, 80), 2.0, np.float32)
    depth_m[:, 40:] = 3.0
    depth_m[:10] = 12.0
    depth_m[50:] = 0.2
    cosine = np.ones_like(depth_m)
    cosine[20:30, :20] = 0.05
    noisy_m = sensor.noisy_depth(depth_m, cosine, rng)
    assert not noisy_m[:8].any() and not noisy_m[52:].any() and not noisy_m[20:30, :20].any()
    assert 0.3 < (noisy_m[12:48, 39:41] == 0).mean() < 0.9
    assert (noisy_m[31:48, 2:38] > 0).all()


def test_colour_noise_exposure_and_blur():
    exact = np.full((100, 100, 3), 0.5, np.float32)
    noisy = sensor.noisy_colour(exact, np.random.default_rng(0))
    assert abs(float(noisy.std()) / sensor.COLOUR_SIGMA - 1) < 0.15
    np.testing.assert_allclose(noisy * 255, np.rint(noisy * 255), atol=1e-3)
    plain, bright = source(), source(exposure_change=0.3)
    quarter = round(sensor.EXPOSURE_PERIOD_S / 4 * 30)
    ratio = bright.read(quarter).colour.mean() / plain.read(quarter).colour.mean()
    assert 1.2 < ratio <= 1.3
    blurred, sharp = (source("turn", motion_blur=n, width=240).read(60) for n in (8, 1))
    assert np.array_equal(blurred.depth_m, sharp.depth_m)
    gradient = [np.abs(np.diff(f.colour, axis=1)).mean() for f in (blurred, sharp)]
    assert gradient[0] < 0.95 * gradient[1]


def steps(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    twists = np.array([se3_log(inverse(a) @ b) for a, b in zip(trajectory.T_wc, trajectory.T_wc[1:], strict=False)])
    return np.rad2deg(np.linalg.norm(twists[:, :3], axis=1)), np.linalg.norm(twists[:, 3:], axis=1)


@pytest.mark.parametrize("scene", SCENES)
def test_the_camera_moves_like_a_hand(scene):
    turns_deg, moves_m = steps(source(scene, frames=1200).groundtruth())
    assert turns_deg.max() < (1.5 if scene == "room" else 2.0)
    assert moves_m.max() < (0.02 if scene == "room" else 0.03)
    assert moves_m.mean() > 0.002 and np.abs(np.diff(moves_m)).max() < 2e-3  # no standing still, no jerks


@pytest.mark.parametrize("scene", CLOSED)
def test_closed_paths_return_to_the_first_pose(scene):
    period = SCENES[scene].period_frames
    assert period is not None
    T_wc = source(scene, frames=2 * period).groundtruth().T_wc
    np.testing.assert_allclose(T_wc[period], T_wc[0], atol=1e-9)
    farthest_m = np.linalg.norm(T_wc[:period, :3, 3] - T_wc[0, :3, 3], axis=1).max()
    assert farthest_m > (0.2 if scene == "turn" else 0.8)


def test_the_corridor_never_comes_back():
    trajectory = source("corridor", frames=2600).groundtruth()
    position = trajectory.T_wc[::20, :3, 3]
    length_m = np.linalg.norm(np.diff(trajectory.T_wc[:, :3, 3], axis=0), axis=1).sum()
    assert length_m > 40
    gap_m = np.linalg.norm(position[:, None] - position[None], axis=2)
    apart_s = np.abs(np.subtract.outer(trajectory.timestamps_s[::20], trajectory.timestamps_s[::20]))
    assert (gap_m >= 0.6 * corridor.SPEED_M_S * apart_s - 0.5).all()


def test_the_desk_scene_has_coplanar_tops_and_a_thin_wall_seen_from_both_sides():
    one = source("desk", frames=660)
    seen = np.unique(np.concatenate([one.labels(i).ravel() for i in range(0, 660, 60)]))
    planes = one.planes()[seen[seen >= 0]]
    tops = np.isclose(planes[:, 3], -0.74) & np.isclose(planes[:, 2], 1.0)
    assert tops.sum() == 2
    sides = planes[np.abs(planes[:, 1]) > 0.99]
    assert any(np.isclose(a[1], -b[1]) and np.isclose(a[3] + b[3], -0.03) for a in sides for b in sides)


def test_low_texture_is_low():
    def texture(scene: str) -> float:
        one = source(scene)
        return float(np.mean([np.abs(np.diff(one.clean(i).colour, axis=1)).mean() for i in (0, 150, 300)]))

    assert texture("blank") < 0.5 * texture("room")


def test_what_a_source_offers():
    one = source(noise=True)
    frame = one.read(7)
    assert (one.name, len(one)) == ("synthetic-room", 400)
    assert frame.colour.shape == (76, 100, 3) and frame.depth_m.shape == (76, 100)
    assert frame.colour.dtype == frame.depth_m.dtype == np.float32
    assert frame.colour.min() >= 0 and frame.colour.max() <= 1
    trajectory = one.groundtruth()
    assert trajectory.timestamps_s[7] == frame.timestamp_s
    assert np.array_equal(trajectory.T_wc[7], one.pose(7))
    with pytest.raises(IndexError, match="400"):
        one.read(400)
    with pytest.raises(IndexError):
        one.read(-1)


def test_the_default_dataset_is_the_synthetic_room():
    opened = open_source(told_format(DatasetConfig(), None), SyntheticConfig(), 0, None)
    assert isinstance(opened, SyntheticSource) and opened.name == "synthetic-room"


def test_an_unknown_scene_is_an_error_that_names_the_scenes():
    with pytest.raises(ConfigError) as caught:
        source("castle")
    assert all(name in str(caught.value) for name in ("castle", *SCENES))


def test_export_writes_a_tum_folder(tmp_path: Path, capsys):
    folder = tmp_path / "room"
    arguments = [str(folder), "--frames", "3", "--width", "64", "--height", "48", "--seed", "2"]
    assert export_synthetic.main(arguments) == 0
    one = source(seed=2, width=64, height=48, frames=3, noise=True)
    assert all((folder / f"{kind}.txt").read_text().count(".png") == 3 for kind in ("rgb", "depth"))
    frame = one.read(1)
    raw = cv2.imread(str(folder / "depth" / f"{frame.timestamp_s:.6f}.png"), cv2.IMREAD_UNCHANGED)
    assert raw.dtype == np.uint16
    np.testing.assert_allclose(raw / 5000.0, frame.depth_m, atol=1.01e-4)
    read_back = open_source(load(folder / "camera.yaml").dataset, SyntheticConfig(), 0, folder)
    assert read_back.camera == one.camera and len(read_back) == 3
    np.testing.assert_allclose(read_back.read(1).colour, frame.colour, atol=1e-4)
    np.testing.assert_allclose(read_back.read(1).depth_m, frame.depth_m, atol=1.01e-4)
    rows = np.loadtxt(folder / "groundtruth.txt")
    np.testing.assert_allclose(rows[2, 1:4], one.pose(2)[:3, 3], atol=1e-8)
    np.testing.assert_allclose(matrix_from_quat_wxyz(rows[2, [7, 4, 5, 6]]), one.pose(2)[:3, :3], atol=1e-7)
    assert export_synthetic.main(arguments) != 0
    assert "not an empty folder" in capsys.readouterr().err
    assert export_synthetic.main([str(tmp_path / "none"), "--frames", "0"]) == ConfigError.exit_code
    assert "synthetic.frames" in capsys.readouterr().err and not (tmp_path / "none").exists()


def test_a_scene_played_as_a_stream_is_the_same():
    one, sent = source(frames=4, width=32, height=24), io.BytesIO()
    assert play(one, sent) == 4
    sent.seek(0)
    back = LiveSource(StreamReader(sent.readinto, "stream"), DatasetConfig())
    assert (back.name, back.camera) == (one.name, one.camera)
    frames = list(back.frames())
    assert len(frames) == 4
    for k, frame in enumerate(frames):
        expected = one.read(k)
        assert (frame.index, frame.timestamp_s) == (k, expected.timestamp_s)
        np.testing.assert_allclose(frame.colour, expected.colour, atol=0.501 / 255)  # 8 bits
        np.testing.assert_array_equal(frame.depth_m, expected.depth_m)
