"""Every layout: what is written in it is read back, whole, and what is damaged is said in one line."""

from __future__ import annotations

import re
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.recordings.bags import MCAP, MOTION, REALSENSE, ROS1, ROS2
from tests.recordings.folders import BONN, FOLDER, OPEN3D, REDWOOD, TIMES, TUM
from tests.recordings.kinect import BUNDLE_FUSION, SCANNET, SCENES_MOTION, SENS, SEVEN_SCENES
from tests.recordings.phones import NERFSTUDIO, POLYCAM, RECORD3D, SCANNETPP, record3d_members, write_zip
from tests.recordings.rendered import REPLICA, TARTANAIR_V1, TARTANAIR_V2
from tests.recordings.shots import Case, shots, write_image, write_json
from tests.test_layers import CHECKOUT
from tgslam.config.input_settings import FOLDER_FORMATS, DatasetConfig, DatasetExpert, SyntheticConfig
from tgslam.datasets import RgbdSource, open_source, open_stored
from tgslam.datasets.detection import told_format
from tgslam.datasets.formats import LAYOUTS
from tgslam.errors import ConfigError, FrameError, TgslamError
from tgslam.geometry import inverse
from tgslam.types import Trajectory
from tools.markdown_block import blocks

REGISTERED = [
    REPLICA, TARTANAIR_V1, TARTANAIR_V2, BUNDLE_FUSION, SCANNET, SENS, OPEN3D, REDWOOD, BONN, TUM, FOLDER, NERFSTUDIO,
    SCANNETPP, RECORD3D, POLYCAM, ROS1, ROS2, MCAP,
]  # fmt: skip
CASES = [*REGISTERED, SEVEN_SCENES]


def opened(case: Case, path: Path) -> RgbdSource:
    config = told_format(DatasetConfig(**case.settings), path)
    assert config.format == case.format
    return open_source(config, SyntheticConfig(), 0, path)


@pytest.mark.parametrize("case", REGISTERED, ids=lambda case: case.label)
def test_frames_and_poses_are_those_that_were_written(case: Case, tmp_path: Path) -> None:
    source = opened(case, case.write(tmp_path))
    assert len(source) == 3
    np.testing.assert_allclose(source.camera.intrinsics, case.intrinsics, rtol=1e-6)
    for k, shot in enumerate(shots()):
        frame = source.read(k)
        assert frame.timestamp_s == pytest.approx(case.times_s[k], abs=1e-6)
        np.testing.assert_allclose(frame.colour, shot.colour / 255.0, atol=(case.colour_steps + 0.01) / 255)
        np.testing.assert_allclose(frame.depth_m, shot.depth_m, atol=2e-4)
        assert frame.colour.dtype == frame.depth_m.dtype == np.float32
    check_poses(case, source.groundtruth())


def check_poses(case: Case, truth: Trajectory | None) -> None:
    """Motions are the same, whatever the recording's world."""
    if not case.has_poses:
        assert truth is None
        return
    assert truth is not None
    np.testing.assert_allclose(truth.timestamps_s, case.times_s, atol=1e-6)
    written = np.stack([shot.T_wc for shot in shots()])
    np.testing.assert_allclose(inverse(truth.T_wc[0]) @ truth.T_wc, inverse(written[0]) @ written, atol=2e-6)


def test_seven_scenes_has_a_depth_camera_of_its_own(tmp_path: Path) -> None:
    path, config = SEVEN_SCENES.write(tmp_path), DatasetConfig(format="7scenes", fx=30.0, fy=31.0, cx=15.0, cy=11.5)
    stored = open_stored(config, path)
    assert stored.depth_camera is not None and stored.depth_units == 1000.0
    np.testing.assert_array_equal(stored.depth_camera.T_colour_depth, SCENES_MOTION)
    assert stored.depth_camera.calibration.matrix.tolist() == [[585, 0, 320], [0, 585, 240], [0, 0, 1]]
    for k, shot in enumerate(shots()):
        np.testing.assert_array_equal(stored.frames.colour(k), shot.colour)
        np.testing.assert_array_equal(stored.frames.depth(k), shot.depth_mm)
    check_poses(SEVEN_SCENES, stored.poses())


def test_depth_of_instant_ngp_has_units_of_its_own(tmp_path: Path) -> None:
    path = NERFSTUDIO.write(tmp_path)
    text = (path / "transforms.json").read_text().replace("depth_file_path", "depth_path")
    (path / "transforms.json").write_text(text.replace('"k1"', '"integer_depth_scale": 0.0005, "k1"'))
    source = opened(NERFSTUDIO, path)
    np.testing.assert_allclose(source.read(1).depth_m, shots()[1].depth_m / 2, atol=1e-6)


def test_a_camera_that_cannot_be_is_said_with_the_recording(tmp_path: Path) -> None:
    path = REPLICA.write(tmp_path)
    write_json(tmp_path / "cam_params.json", {"camera": {"w": 32, "h": 24, "fx": -1, "fy": 1, "cx": 1, "cy": 1}})
    with pytest.raises(ConfigError, match=r"room0: dataset\.fx is -1"):
        opened(REPLICA, path)


def test_realsense_has_a_depth_camera_of_its_own_and_its_units(tmp_path: Path) -> None:
    stored = open_stored(DatasetConfig(format="ros"), REALSENSE.write(tmp_path))
    assert stored.depth_camera is not None and stored.depth_units == pytest.approx(10_000.0)
    np.testing.assert_allclose(stored.depth_camera.T_colour_depth[:3, 3], MOTION)
    assert stored.depth_camera.calibration.matrix.tolist() == [[20, 0, 16], [0, 20, 12], [0, 0, 1]]
    assert stored.calibration.matrix.tolist() == [[30, 0, 15], [0, 31, 11.5], [0, 0, 1]]
    for k in (2, 0, 1):
        np.testing.assert_array_equal(stored.frames.colour(k), shots()[k].colour)
        np.testing.assert_array_equal(stored.frames.depth(k), shots()[k].depth_mm * 10)


def test_topics_of_a_bag_may_be_named(tmp_path: Path) -> None:
    topics = DatasetExpert(colour_topic="/camera/infra1/image_rect_raw", depth_topic="/camera/depth/image_rect_raw")
    path = ROS1.write(tmp_path)
    frames = open_stored(DatasetConfig(format="ros", expert=topics), path).frames
    np.testing.assert_array_equal(frames.colour(1), np.repeat(shots()[1].colour[..., :1], 3, axis=2))
    np.testing.assert_array_equal(frames.depth(1), shots()[1].depth_mm // 2)
    with pytest.raises(ConfigError, match=r"no images of topic '/depth' .*aligned_depth_to_color"):
        open_stored(DatasetConfig(format="ros", expert=DatasetExpert(depth_topic="/depth")), path)


DAMAGES = [(case, name) for case in CASES for name in case.damages]


@pytest.mark.parametrize(("case", "name"), DAMAGES, ids=lambda value: value if isinstance(value, str) else value.label)
def test_damage_is_said_in_one_line_that_names_the_file(case: Case, name: str, tmp_path: Path) -> None:
    damage, message = case.damages[name]
    path = case.write(tmp_path)
    damage(path)
    with pytest.raises(TgslamError, match=message) as caught:
        config = told_format(DatasetConfig(**case.settings), path)
        stored = open_stored(config, path)
        stored.poses()
        for k in range(len(stored.frames.times_s)):
            stored.frames.colour(k), stored.frames.depth(k)
    assert "\n" not in str(caught.value)


def test_every_layout_is_a_format_and_has_three_damages() -> None:
    assert {layout.name for layout in LAYOUTS} == set(FOLDER_FORMATS)
    assert {case.format for case in CASES} == set(FOLDER_FORMATS) - {"icl"}  # test_datasets.py has it
    assert all(len(case.damages) >= 3 for case in CASES)


def test_depth_of_record3d_by_lzfse(tmp_path: Path) -> None:
    lzfse = pytest.importorskip("lzfse")
    path = write_zip(tmp_path / "room.r3d", record3d_members(lzfse.compress))
    frames = open_stored(DatasetConfig(format="record3d"), path).frames
    np.testing.assert_array_equal(frames.depth(1), shots()[1].depth_m)
    damaged = write_zip(tmp_path / "bad.r3d", record3d_members(lambda data: lzfse.compress(data)[:-9]))
    with pytest.raises(FrameError, match=r"bad\.r3d: rgbd/1\.depth: "):
        open_stored(DatasetConfig(format="record3d"), damaged).frames.depth(1)


def test_lzfse_that_is_not_installed_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lzfse", None)
    path = write_zip(tmp_path / "room.r3d", record3d_members(lambda data: b"bvx2" + data))
    with pytest.raises(FrameError, match=r"pip install tgslam\[record3d\]"):
        open_stored(DatasetConfig(format="record3d"), path).frames.depth(0)


def test_an_unpacked_record3d_is_read_too(tmp_path: Path) -> None:
    zipfile.ZipFile(write_zip(tmp_path / "room.r3d", record3d_members())).extractall(tmp_path / "room")
    source = opened(RECORD3D, tmp_path / "room")
    np.testing.assert_allclose(source.read(2).depth_m, shots()[2].depth_m, atol=1e-6)
    check_poses(RECORD3D, source.groundtruth())


@pytest.mark.parametrize("names", ["{0:.2f}", "{1}"])
def test_folders_of_colour_and_depth_need_a_camera_only(tmp_path: Path, names: str) -> None:
    for k, shot in enumerate(shots()):
        name = names.format(TIMES[k], 9 + k)
        write_image(tmp_path / f"color/{name}.png", shot.colour)
        write_image(tmp_path / f"depth/{name}.png", shot.depth_mm)
    (tmp_path / "color/notes.txt").write_text("none")
    plain = replace(FOLDER, settings={"fx": 30.0, "fy": 31.0, "cx": 15.0, "cy": 11.5})
    source = opened(plain, tmp_path)
    assert source.read(2).timestamp_s == pytest.approx(TIMES[2] if "." in names else 2 / 30)
    np.testing.assert_allclose(source.read(2).colour, shots()[2].colour / 255.0, atol=1e-6)
    np.testing.assert_allclose(source.read(2).depth_m, shots()[2].depth_m, atol=1e-6)
    with pytest.raises(ConfigError, match=r"the camera is not known: set dataset\.fx.*recording\.yaml a camera"):
        opened(FOLDER, tmp_path)


PAGE = CHECKOUT / "docs" / "recordings.md"


def test_the_page_on_recordings_has_every_layout_in_order() -> None:
    rows = re.findall(r"^\| `(\w+)` \|", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert rows == [layout.name for layout in LAYOUTS]


def test_the_description_in_the_page_is_read(tmp_path: Path) -> None:
    (text,) = blocks(PAGE.read_text(encoding="utf-8"), "yaml")
    (tmp_path / "recording.yaml").write_text(text)
    write_image(tmp_path / "left/7.5.png", shots(640, 480)[0].colour)
    write_image(tmp_path / "depth/7.51.tiff", shots(640, 480)[0].depth_m)
    stored = open_stored(DatasetConfig(format="folder"), tmp_path)
    assert stored.frames.times_s == [7.5] and stored.calibration.fx == 525.0
    assert stored.depth_camera is not None and stored.depth_camera.is_concentric
