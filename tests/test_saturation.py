"""Saturated colours: where they are, that they do not count, and that a burst of too bright frames loses nothing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tgslam.adaptation import Slam
from tgslam.camera import Camera
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.schema import Config
from tgslam.datasets.built_in import SyntheticSource
from tgslam.device import runtime
from tgslam.evaluation.trajectory import ate
from tgslam.tracking.saturation import WHOLE, half_covers
from tgslam.types import Frame, FrameStatus

CAMERA = Camera(160, 120, 110.0, 110.0, 79.5, 59.5)


@dataclass
class Level:
    camera: Camera


def covers(colour: np.ndarray, times: int = 3) -> list[np.ndarray]:
    levels = [Level(CAMERA.halved(level)) for level in range(times)]
    found = half_covers(runtime.to_device(colour), levels)
    assert [level for level, _ in found] in ([], levels)
    return [runtime.to_host(cover) for _, cover in found]


def test_one_saturated_channel_is_enough() -> None:
    colour = np.full((*CAMERA.shape, 3), 0.5, np.float32)
    colour[40:80, 32:128, 1] = 1.0
    found = covers(colour)
    assert [cover.shape for cover in found] == [(60, 80), (30, 40), (15, 20)]
    for level, cover in enumerate(found):
        step = 2 ** (level + 1)
        expected = np.ones_like(cover)
        expected[40 // step : 80 // step, 32 // step : 128 // step] = 0.0
        np.testing.assert_allclose(cover, expected, atol=1e-6)
        assert (cover >= WHOLE).sum() == expected.sum()


def test_glints_and_bright_images_that_are_not_saturated_are_left_alone() -> None:
    colour = np.full((*CAMERA.shape, 3), 253.0 / 255.0, np.float32)
    colour[10:12, 10:12] = 1.0
    assert covers(colour) == []


def brighter(frame: Frame, gain: float) -> Frame:
    return replace(frame, colour=np.clip(gain * frame.colour, 0.0, 1.0).astype(np.float32))


def test_a_burst_of_saturated_frames_loses_none() -> None:
    """Two pixels in three are saturated in frames 4 to 12, keyframes among them; those after them are as before."""
    source = SyntheticSource(SyntheticConfig(frames=720, width=160, height=120), seed=0)
    frames = [source.read(index) for index in range(18)]
    burst = [brighter(frame, 2.5) if 4 <= k < 13 else frame for k, frame in enumerate(frames)]
    assert (burst[4].colour >= 1.0).any(axis=2).mean() > 0.6
    errors_m = []
    for played in (frames, burst):
        slam = Slam(source.camera, Config())
        reports = [slam.process_frame(frame) for frame in played]
        assert all(report.status is not FrameStatus.LOST for report in reports)
        errors_m.append(ate(slam.trajectory(), source.groundtruth(), tolerance_s=0.001).rmse_m)
    assert any(report.is_keyframe for report in reports[4:13])
    gains = [report.measures["gain"] for report in reports[4:13]]
    np.testing.assert_allclose(gains, 1.0 / 2.5, rtol=0.05)  # by what is saturated, it would be a tenth more
    assert errors_m[1] < 1.3 * errors_m[0]
