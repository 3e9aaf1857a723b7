"""What `probe` says of recordings whose numbers and faults are known."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tgslam.camera import Camera
from tgslam.cli import main
from tgslam.datasets.edge_alignment import misalignment, warn_of_misalignment
from tgslam.errors import FrameError
from tgslam.inspection.survey import survey
from tgslam.inspection.verdict import table, warnings
from tgslam.types import Frame

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
COUNT = 24


def scene(seed: int) -> Frame:
    """Boxes of their own colour and depth before a wall, sensed as a Kinect does."""
    rng = np.random.default_rng(seed)
    colour = np.full((120, 160, 3), 0.4, np.float32) + np.float32(0.02) * rng.normal(size=(120, 160, 3))
    depth = 3.0 + 0.002 * np.mgrid[:120, :160][1]
    for _ in range(9):
        u, v, w, h = rng.integers((0, 0, 12, 12), (140, 100, 50, 50))
        colour[v : v + h, u : u + w] = rng.uniform(0.1, 0.9, 3)
        depth[v : v + h, u : u + w] = rng.uniform(1.0, 2.5)
    depth = depth + 0.0015 * depth**2 * rng.normal(size=depth.shape)
    return Frame(seed, seed / 30.0, np.clip(colour, 0.0, 1.0).astype(np.float32), depth.astype(np.float32))


class Recorded:
    """Such frames, changed in some way."""

    name = "recorded"
    camera = CAMERA

    def __init__(
        self, change: Callable[[Frame], Frame] = lambda frame: frame, bad: tuple[int, ...] = (), count: int = COUNT
    ) -> None:
        self.change, self.bad, self.count = change, bad, count

    def __len__(self) -> int:
        return self.count

    def read(self, index: int) -> Frame:
        if index in self.bad:
            raise FrameError(f"frame {index} is truncated")
        return self.change(scene(index))

    def groundtruth(self) -> None:
        return None

    def truth(self) -> None:
        return None


def told(
    change: Callable[[Frame], Frame] = lambda frame: frame, depth_scale: float = 1000.0, count: int = COUNT, **more
) -> tuple[dict[str, str], list[str]]:
    """The table and the warnings."""
    found = survey(Recorded(change, count=count, **more))
    return dict(table(found, CAMERA, depth_scale)), warnings(found, CAMERA, depth_scale)


def moved(frame: Frame, right: float, down: float, scale: float) -> Frame:
    """The frame with its depth elsewhere."""
    M = np.array([[scale, 0.0, (1 - scale) * 79.5 + right], [0.0, scale, (1 - scale) * 59.5 + down]])
    return dataclasses.replace(frame, depth_m=cv2.warpAffine(frame.depth_m, M, (160, 120), flags=cv2.INTER_NEAREST))


def test_a_sound_recording_is_described_and_nothing_is_wrong() -> None:
    rows, wrong = told()
    assert wrong == []
    assert rows["frames"] == "24, 0 of them unreadable" and rows["rate"] == "30.00 frames/s" and rows["gaps"] == "none"
    assert rows["size"] == "160x120 px" and rows["field of view"] == "63 degrees across"
    assert rows["exposure steps"] == "none" and rows["pixels with depth"] == "100%"
    assert 0.7 < float(rows["noise of depth"].split()[0]) < 1.4
    low, _, high = rows["depth"].split()[:3]
    assert 0.9 < float(low) < 2.0 and 3.0 < float(high) < 3.5


@pytest.mark.parametrize(("off", "scale"), [((10, 0), 1.0), ((-8, 6), 1.0), ((3, -4), 1.1), ((0, 0), 0.9)])
def test_depth_that_was_not_registered_is_told_by_its_edges(off: tuple[int, int], scale: float) -> None:
    found = misalignment(moved(scene(k), *off, scale) for k in range(6))
    assert found is not None
    assert found.scale == pytest.approx(1.0 / scale, abs=0.04)
    assert found.right_px == pytest.approx(-off[0] / scale, abs=2.5)
    assert found.down_px == pytest.approx(-off[1] / scale, abs=2.5)


@pytest.mark.parametrize("frames", [[], [0], range(6)])
def test_depth_in_its_place_is_no_finding(frames: list[int]) -> None:
    assert misalignment(scene(k) for k in frames) is None


def test_a_blank_wall_says_nothing_of_registration() -> None:
    blank = np.full((120, 160), 2.0, np.float32)
    assert misalignment(dataclasses.replace(scene(k), depth_m=blank) for k in range(6)) is None


def test_a_run_warns_of_it_and_reads_few_frames(caplog: pytest.LogCaptureFixture) -> None:
    warn_of_misalignment(Recorded(bad=(0,)))
    assert not caplog.text
    source = Recorded(lambda frame: moved(frame, 12, 0, 1.0))
    read: list[int] = []
    source.read = lambda index: read.append(index) or moved(scene(index), 12, 0, 1.0)  # type: ignore[method-assign]
    warn_of_misalignment(source)
    assert "recorded: depth does not lie on colour" in caplog.text and len(read) == 6


def test_what_is_wrong_is_said_with_its_likely_cause() -> None:
    _, wrong = told(lambda frame: moved(frame, 12, 0, 1.0), count=6)
    assert len(wrong) == 1 and "dataset.depth_camera" in wrong[0] and "-12 px to the right" in wrong[0]
    _, wrong = told(lambda f: dataclasses.replace(f, depth_m=f.depth_m / np.float32(5.0)), depth_scale=5000.0, count=5)
    assert "dataset.depth_scale=5000 is likely wrong: 1000" in wrong[0]
    _, wrong = told(lambda f: dataclasses.replace(f, timestamp_s=1e4 * f.index), count=3)
    assert "10000 s apart" in wrong[0]
    rows, wrong = told(bad=(1, 3), count=5)
    assert rows["frames"] == "5, 2 of them unreadable" and wrong == [
        "2 frames cannot be read; the first: frame 1 is truncated"
    ]
    narrow = dataclasses.replace(CAMERA, fx=525.0)
    assert "17 degrees" in warnings(survey(Recorded(count=2)), narrow, 1000.0)[0]


def test_gaps_and_exposure_steps_are_where_they_are() -> None:
    def changed(frame: Frame) -> Frame:
        late = 0.5 if frame.index >= 10 else 0.0
        gain = np.float32(0.7 if frame.index >= 15 else 1.0)
        return dataclasses.replace(scene(0), timestamp_s=frame.timestamp_s + late, colour=scene(0).colour * gain)

    rows, _ = told(changed)
    assert rows["gaps"] == "1: 0.53 s after frame 9"
    assert rows["exposure steps"] == "1: x0.70 at frame 15"


def test_the_command_prints_what_the_recording_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k in range(3):
        frame = scene(k)
        for kind, image in (("rgb", frame.colour * 255), ("depth", frame.depth_m * 1000)):
            (tmp_path / kind).mkdir(exist_ok=True)
            cv2.imwrite(str(tmp_path / kind / f"{k}.png"), image.astype(np.uint8 if kind == "rgb" else np.uint16))
            with (tmp_path / f"{kind}.txt").open("a") as file:
                file.write(f"{k * 100_000_000} {kind}/{k}.png\n")
    camera = [text for key in ("fx", "fy") for text in ("--set", f"dataset.{key}=130")]
    camera += ["--set", "dataset.cx=79.5", "--set", "dataset.cy=59.5", "--set", "dataset.depth_scale=1000"]
    assert main(["probe", "--input", str(tmp_path), *camera]) == 0
    output, log = capsys.readouterr()
    assert "format tum" in output and "3, 0 of them unreadable" in output and "10.00 frames/s" in output
    assert "in nanoseconds" in log
