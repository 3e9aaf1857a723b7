"""Recordings written in other layouts: read back, they are the same; interrupted, they go on."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.fakes import true_pose
from tgslam.camera import Camera
from tgslam.cli import main
from tgslam.config.input_settings import DatasetConfig, SyntheticConfig
from tgslam.config.loader import load
from tgslam.conversion.converter import convert
from tgslam.conversion.targets import LAYOUTS
from tgslam.datasets import open_source
from tgslam.datasets.detection import told_format
from tgslam.datasets.known_poses import KnownPoses
from tgslam.errors import DatasetError, FrameError, OutputError
from tgslam.types import Frame, Trajectory

CAMERA = Camera(24, 16, 20.0, 21.0, 11.0, 8.0)
COUNT = 5


class TexturedSource:
    """Frames of noise, so that none is like another, at 10 Hz. It counts how often each is read."""

    name = "textured"
    camera = CAMERA

    def __init__(self, bad: tuple[int, ...] = (), fails_at: int | None = None) -> None:
        self.bad, self.fails_at = bad, fails_at
        self.reads: list[int] = []

    def __len__(self) -> int:
        return COUNT

    def read(self, index: int) -> Frame:
        if index == self.fails_at:
            raise KeyboardInterrupt
        if index in self.bad:
            raise FrameError(f"frame {index} is truncated")
        self.reads.append(index)
        rng = np.random.default_rng(index)
        rgb = rng.integers(0, 256, (16, 24, 3)).astype(np.float32) / np.float32(255.0)
        return Frame(index, 5.0 + 0.1 * index, rgb, rng.uniform(0.5, 9.0, (16, 24)).astype(np.float32))

    def groundtruth(self) -> Trajectory:
        return Trajectory(5.0 + 0.1 * np.arange(COUNT), np.stack([true_pose(k) for k in range(COUNT)]))

    def truth(self) -> None:
        return None


def write(folder: Path, to: str, source: TexturedSource | None = None, **more: str):
    source = source or TexturedSource()
    truth = source.groundtruth()
    return convert(source, folder, to, KnownPoses(truth), truth, **more)


def read_image(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image


@pytest.mark.parametrize("to", ["tum", "icl"])
def test_a_layout_that_is_read_here_gives_the_recording_back(tmp_path: Path, to: str) -> None:
    assert write(tmp_path / "out", to).written == COUNT
    config = load(tmp_path / "out" / "camera.yaml").dataset
    back, source = open_source(config, SyntheticConfig(), 0, tmp_path / "out"), TexturedSource()
    assert back.camera == CAMERA and len(back) == COUNT
    for k in range(COUNT):
        frame, expected = back.read(k), source.read(k)
        np.testing.assert_allclose(frame.colour, expected.colour, atol=1e-6)
        np.testing.assert_allclose(frame.depth_m, expected.depth_m, atol=1.01e-4)
        assert frame.timestamp_s == pytest.approx(expected.timestamp_s if to == "tum" else k)
    truth = back.groundtruth()
    assert truth is not None and len(truth) == COUNT
    np.testing.assert_allclose(truth.T_wc, source.groundtruth().T_wc, atol=1e-8)
    assert not list((tmp_path / "out").glob(".*"))


def test_icl_is_stored_from_the_last_row_on(tmp_path: Path) -> None:
    write(tmp_path / "out", "icl")
    stored = read_image(tmp_path / "out" / "rgb" / "2.png")[..., ::-1]
    np.testing.assert_array_equal(stored[::-1], np.round(TexturedSource().read(2).colour * 255))
    assert load(tmp_path / "out" / "camera.yaml").dataset.fy == -21.0


def test_replica_as_nice_slam_reads_it(tmp_path: Path) -> None:
    write(tmp_path / "out", "replica")
    assert json.loads((tmp_path / "out" / "cam_params.json").read_text()) == {
        "camera": {"w": 24, "h": 16, "fx": 20.0, "fy": 21.0, "cx": 11.0, "cy": 8.0, "scale": 6553.5}
    }
    poses = np.loadtxt(tmp_path / "out" / "traj.txt").reshape(-1, 4, 4)
    np.testing.assert_allclose(poses, TexturedSource().groundtruth().T_wc, atol=1e-10)
    depth = read_image(tmp_path / "out" / "results" / "depth000003.png")
    np.testing.assert_allclose(depth / 6553.5, TexturedSource().read(3).depth_m, atol=1e-4)
    assert read_image(tmp_path / "out" / "results" / "frame000004.jpg").shape == (16, 24, 3)


def test_nerfstudio_with_its_axes_and_its_pixel_centres(tmp_path: Path) -> None:
    write(tmp_path / "out", "nerfstudio")
    values = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert (values["fl_x"], values["cx"], values["cy"], values["w"]) == (20.0, 11.5, 8.5, 24)
    frame = values["frames"][2]
    expected = true_pose(2)
    transform = np.array(frame["transform_matrix"])
    np.testing.assert_allclose(transform[:3, 3], expected[:3, 3])
    np.testing.assert_allclose(transform[:3, 2], -expected[:3, 2])  # it looks along -z
    np.testing.assert_allclose(transform[:3, 1], -expected[:3, 1])
    depth = read_image(tmp_path / "out" / frame["depth_file_path"])
    np.testing.assert_allclose(depth * 0.001, TexturedSource().read(2).depth_m, atol=5.1e-4)
    colour = read_image(tmp_path / "out" / frame["file_path"])[..., ::-1]
    np.testing.assert_array_equal(colour, np.round(TexturedSource().read(2).colour * 255))


@pytest.mark.parametrize(("to", "step_m"), [("replica", 1.0 / 6553.5), ("nerfstudio", 0.001)])
def test_a_layout_that_others_read_is_read_here_too(tmp_path: Path, to: str, step_m: float) -> None:
    write(tmp_path / "out", to)
    config = told_format(DatasetConfig(), tmp_path / "out")
    back, source = open_source(config, SyntheticConfig(), 0, tmp_path / "out"), TexturedSource()
    assert config.format == to and len(back) == COUNT
    np.testing.assert_allclose(back.camera.intrinsics, CAMERA.intrinsics)
    for k in range(COUNT):
        np.testing.assert_allclose(back.read(k).depth_m, source.read(k).depth_m, atol=0.51 * step_m)
    truth = back.groundtruth()
    assert truth is not None
    np.testing.assert_allclose(truth.T_wc, source.groundtruth().T_wc, atol=1e-8)


@pytest.mark.parametrize("cut", ["", '{"number": 2, "timest'])
def test_an_interrupted_conversion_goes_on(tmp_path: Path, cut: str) -> None:
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        write(out, "replica", TexturedSource(bad=(1,), fails_at=3))
    journal = out / ".conversion.jsonl"
    journal.write_text(journal.read_text() + cut)
    again = TexturedSource(bad=(1,))
    assert write(out, "replica", again) == write(tmp_path / "at once", "replica", TexturedSource(bad=(1,)))
    assert again.reads == [3, 4]
    for path in sorted((tmp_path / "at once").rglob("*.*")):
        assert path.read_bytes() == (out / path.relative_to(tmp_path / "at once")).read_bytes()
    assert not journal.exists() and len(list(out.rglob("frame*.jpg"))) == COUNT - 1


def test_what_was_begun_otherwise_is_not_gone_on_with(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "out", "tum", TexturedSource(fails_at=3))
    with pytest.raises(OutputError, match="to another layout"):
        write(tmp_path / "out", "icl")
    with pytest.raises(OutputError, match="something else"):
        write(tmp_path / "out", "tum", told="other settings")
    write(tmp_path / "out", "tum")
    with pytest.raises(OutputError, match="not an empty folder"):
        write(tmp_path / "out", "tum")


def test_frames_without_a_pose_are_left_out_where_each_needs_one(tmp_path: Path) -> None:
    source, truth = TexturedSource(), TexturedSource().groundtruth()
    some = KnownPoses(Trajectory(truth.timestamps_s[2:], truth.T_wc[2:]))
    done = convert(source, tmp_path / "replica", "replica", some)
    assert (done.written, done.left_out) == (3, 2)
    poses = np.loadtxt(tmp_path / "replica" / "traj.txt").reshape(-1, 4, 4)
    np.testing.assert_allclose(poses, truth.T_wc[2:], atol=1e-10)
    first = read_image(tmp_path / "replica" / "results" / "depth000000.png")
    np.testing.assert_allclose(first / 6553.5, source.read(2).depth_m, atol=1e-4)
    assert convert(source, tmp_path / "tum", "tum", some).written == COUNT
    assert len((tmp_path / "tum" / "groundtruth.txt").read_text().splitlines()) == 3
    with pytest.raises(DatasetError, match="--poses"):
        convert(source, tmp_path / "none", "nerfstudio")
    assert not (tmp_path / "none").exists()


def test_what_has_no_place_in_16_bits_is_no_depth(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Far(TexturedSource):
        def read(self, index: int) -> Frame:
            frame = super().read(index)
            frame.depth_m[0, :3] = 11.0
            return frame

    write(tmp_path / "out", "replica", Far())
    assert "3 depths beyond 10.0 m have no place" in caplog.text
    assert (read_image(tmp_path / "out" / "results" / "depth000000.png")[0, :3] == 0).all()


def test_the_command_writes_a_folder_that_run_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "tum", "tum")
    arguments = ["convert", str(tmp_path / "tum" / "camera.yaml"), "--input", str(tmp_path / "tum"), "--frames", "1:4"]
    assert main([*arguments, "--to", "replica", "--output", str(tmp_path / "out")]) == 0
    poses = np.loadtxt(tmp_path / "out" / "traj.txt").reshape(-1, 4, 4)
    np.testing.assert_allclose(poses, TexturedSource().groundtruth().T_wc[1:4], atol=1e-8)
    poses_file = tmp_path / "poses.txt"
    poses_file.write_text("\n".join(" ".join(map(str, true_pose(k + 7)[:3].ravel())) for k in range(COUNT)))
    more = ["--to", "nerfstudio", "--output", str(tmp_path / "by poses"), "--poses", str(poses_file)]
    assert main([*arguments, *more]) == 0
    values = json.loads((tmp_path / "by poses" / "transforms.json").read_text())
    np.testing.assert_allclose(np.array(values["frames"][0]["transform_matrix"])[:3, 3], true_pose(8)[:3, 3])
    capsys.readouterr()
    assert main([*arguments, *more]) == 1
    assert "not an empty folder" in capsys.readouterr().err
    assert set(LAYOUTS) == {"tum", "icl", "replica", "nerfstudio"}
