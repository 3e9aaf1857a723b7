"""The Python API: what programs import, and that it does what the commands do."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tgslam
from tgslam.cli import main
from tgslam.config.input_settings import SyntheticConfig
from tgslam.datasets.image_files import read_raw_depth
from tgslam.errors import ConfigError, DatasetError, FrameError, OutputError
from tgslam.output.ply import read_map
from tgslam.output.trajectory_io import read_trajectory


def small(**changes: object) -> tgslam.Config:
    """The built-in room in few pixels."""
    scene = SyntheticConfig(width=160, height=120, frames=720)
    return replace(tgslam.Config(), synthetic=scene, **changes)


def ten_lines(folder: Path, frames: str, output: Path, settings: list[str]) -> tgslam.Slam:
    """The program of the README, on a folder."""
    recording = tgslam.open_recording(folder, frames=frames)
    slam = tgslam.Slam(recording.camera, tgslam.load_config(None, settings))
    for frame in recording:
        report = slam.process_frame(frame)
        assert report.T_wc is not None
    slam.finish()
    tgslam.save_run(slam, output)
    return slam


@pytest.mark.parametrize("clip", ["tum_clip", "icl_clip"])
def test_ten_lines_on_a_real_clip_give_what_run_gives(
    clip: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    folder = request.getfixturevalue(clip)
    short = "mapping.final_iterations=12"  # the same steps as 120 are
    ten_lines(folder, "0:8", tmp_path / "program", [short])
    arguments = ["run", "--input", str(folder), "--frames", "0:8", "--output", str(tmp_path / "run"), "--quiet"]
    assert main([*arguments, "--set", short]) == 0
    for name in ("trajectory.txt", "keyframes.txt", "map.ply", "planes.json"):
        assert (tmp_path / "program" / name).read_bytes() == (tmp_path / "run" / name).read_bytes(), name


def test_reports_carry_the_pose_and_the_state_can_be_read_between_frames(tmp_path: Path) -> None:
    config = small()
    recording = tgslam.open_recording(None, config, frames="0:24")
    assert (len(recording), recording.camera.width) == (24, 160)
    slam, reports, counts = tgslam.Slam(recording.camera, config), [], []
    for frame in recording:
        reports.append(slam.process_frame(frame))
        trajectory = slam.trajectory()
        assert len(trajectory) == len(reports)
        np.testing.assert_array_equal(trajectory.T_wc[-1], reports[-1].T_wc)
        counts.append(len(slam.gaussians()))
    assert counts[0] > 1000 and counts == [report.gaussians for report in reports]
    run = tgslam.save_run(slam, tmp_path / "run", reports=reports)
    np.testing.assert_allclose(read_trajectory(run.trajectory).T_wc, slam.trajectory().T_wc, atol=1e-8)
    assert len(read_map(run.map)) == counts[-1]
    planes = json.loads((run.path / "planes.json").read_text())["planes"]
    assert [plane["id"] for plane in planes] == [plane.id for plane in slam.planes()]
    assert main(["render", str(run.path), "--keyframes", "--quiet"]) == 0
    with pytest.raises(OutputError, match="holds a run already"):
        tgslam.save_run(slam, tmp_path / "run")


def test_what_a_driver_gives_is_tracked_as_what_the_reader_gives(tum_clip: Path) -> None:
    """8-bit colour and 16-bit depth with a scale: the same poses, to the last bit."""
    recording = tgslam.open_recording(tum_clip, frames="0:4")
    plain, driven = (tgslam.Slam(recording.camera, tgslam.Config()) for _ in range(2))
    for frame in recording:
        raw = np.rint(frame.depth_m * 5000).astype(np.uint16)
        colour = np.rint(frame.colour * 255).astype(np.uint8)
        as_given = tgslam.Frame(frame.index, frame.timestamp_s, colour, raw, depth_scale=5000.0)
        poses = [slam.process_frame(one).T_wc for slam, one in ((plain, frame), (driven, as_given))]
        np.testing.assert_allclose(poses[0], poses[1], atol=1e-9)
    assert read_raw_depth(next((tum_clip / "depth").glob("*.png"))).dtype == np.uint16


def test_a_refused_frame_changes_nothing() -> None:
    config = small()
    recording = tgslam.open_recording(None, config, frames="0:3")
    slam, undisturbed = (tgslam.Slam(recording.camera, config) for _ in range(2))
    for frame in recording:
        undisturbed.process_frame(frame)
        slam.process_frame(frame)
        for wrong in (frame, replace(frame, timestamp_s=9.0, colour=255 * frame.colour)):
            with pytest.raises(FrameError, match=f"frame {frame.index}"):
                slam.process_frame(wrong)
    np.testing.assert_array_equal(slam.trajectory().T_wc, undisturbed.trajectory().T_wc)


def test_recordings_that_cannot_be_opened_are_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such folder"):
        tgslam.open_recording(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="its format is not known"):
        tgslam.open_recording(tmp_path)
    with pytest.raises(DatasetError, match=r"rgb\.txt"):
        tgslam.open_recording(tmp_path, format="tum")
    with pytest.raises(ConfigError, match="START:STOP:STEP"):
        tgslam.open_recording(None, small(), frames="many")
    with pytest.raises(IndexError, match="frames 0 to 2, not 3"):
        tgslam.open_recording(None, small(), frames="0:3")[3]


def test_names_are_imported_when_they_are_asked_for() -> None:
    code = (
        "import sys, tgslam; assert 'taichi' not in sys.modules and 'numpy' not in sys.modules;"
        "tgslam.Camera, tgslam.Frame, tgslam.load_config('tum'); assert 'taichi' not in sys.modules;"
        "assert set(tgslam.__all__) <= set(dir(tgslam));"
        "print([getattr(tgslam, name).__name__ for name in tgslam.__all__])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str([{"load_config": "load"}.get(name, name) for name in tgslam.__all__])
    with pytest.raises(AttributeError, match="no attribute 'Slamm'"):
        _ = tgslam.Slamm
