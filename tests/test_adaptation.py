"""Any sensor, any scale: tiny, large, noisy and holed versions of the built-in room, and what comes out in metres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tgslam.adaptation import Slam
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.loader import load
from tgslam.config.schema import Config
from tgslam.datasets.built_in import SyntheticSource
from tgslam.errors import FrameError
from tgslam.evaluation.trajectory import ate
from tgslam.slam import Slam as RoomSlam
from tgslam.types import Frame, FrameStatus, Trajectory

FRAMES = 18
PLANES = ["planes.enabled=true", "closures.enabled=true"]


@pytest.fixture(scope="module")
def room() -> SyntheticSource:
    return SyntheticSource(SyntheticConfig(frames=720, width=160, height=120), seed=0)


@pytest.fixture(scope="module")
def frames(room: SyntheticSource) -> list[Frame]:
    return [room.read(index) for index in range(FRAMES)]


def scaled(frames: list[Frame], factor: float) -> list[Frame]:
    return [replace(frame, depth_m=frame.depth_m * np.float32(factor)) for frame in frames]


def noisier(frame: Frame, per_m2: float, holes: float) -> Frame:
    rng, depth_m = np.random.default_rng(frame.index), frame.depth_m
    noisy = depth_m + per_m2 * depth_m**2 * rng.standard_normal(depth_m.shape).astype(np.float32)
    gone = (depth_m == 0) | (rng.random(depth_m.shape) < holes)
    return replace(frame, depth_m=np.where(gone, np.float32(0.0), np.maximum(noisy, np.float32(0.0))))


def play(room: SyntheticSource, frames: list[Frame], config: Config | None = None) -> Slam:
    slam = Slam(room.camera, config or Config())
    statuses = [slam.process_frame(frame).status for frame in frames]
    assert statuses == [FrameStatus.INITIAL] + [FrameStatus.TRACKED] * (len(frames) - 1)
    return slam


def ate_m(slam: Slam, room: SyntheticSource, size: float = 1.0) -> float:
    truth = room.groundtruth()
    T_wc = truth.T_wc.copy()
    T_wc[:, :3, 3] *= size
    return ate(slam.trajectory(), Trajectory(truth.timestamps_s, T_wc), tolerance_s=0.001).rmse_m


def test_the_usual_sensor_in_a_room_changes_nothing(room: SyntheticSource, frames: list[Frame]) -> None:
    adaptive, fixed = play(room, frames[:6]), RoomSlam(room.camera, Config())
    for frame in frames[:6]:
        fixed.process_frame(frame)
    np.testing.assert_array_equal(adaptive.trajectory().T_wc, fixed.trajectory().T_wc)
    np.testing.assert_array_equal(adaptive.gaussians().mean, fixed.gaussians().mean)


def test_a_world_of_an_eighth_is_the_same_world_in_other_units(room: SyntheticSource, frames: list[Frame]) -> None:
    """A power of two rounds nothing, so all that comes out is the same to the last bit of what went into it."""
    config = load(None, [*PLANES, "unit_m=0.125", "loss.depth_sigma_per_m2=0.012"])
    usual = load(None, [*PLANES, "loss.depth_sigma_per_m2=0.0015"])
    small, large = Slam(room.camera, config), Slam(room.camera, usual)
    for frame, same in zip(scaled(frames, 0.125), frames, strict=True):
        report, other = small.process_frame(frame), large.process_frame(same)
        np.testing.assert_array_equal(8.0 * report.T_wc[:3, 3], other.T_wc[:3, 3])
    small.finish()
    large.finish()
    for found, expected in (
        (small.trajectory(), large.trajectory()),
        (small.keyframe_trajectory(), large.keyframe_trajectory()),
    ):
        np.testing.assert_array_equal(found.T_wc[:, :3, :3], expected.T_wc[:, :3, :3])
        np.testing.assert_array_equal(8.0 * found.T_wc[:, :3, 3], expected.T_wc[:, :3, 3])
    np.testing.assert_array_equal(8.0 * small.gaussians().mean, large.gaussians().mean)
    scales = np.exp(small.gaussians().log_scale), np.exp(large.gaussians().log_scale)
    np.testing.assert_allclose(8.0 * scales[0], scales[1], rtol=1e-5)
    assert len(small.planes()) == len(large.planes()) > 2
    for plane, same_plane in zip(small.planes(), large.planes(), strict=True):
        np.testing.assert_array_equal(plane.normal_w, same_plane.normal_w)
        assert 8.0 * plane.offset_m == same_plane.offset_m
        assert 64.0 * plane.area_m2 == same_plane.area_m2
        np.testing.assert_allclose(
            plane.covariance * np.array([[1, 1, 8], [1, 1, 8], [8, 8, 64]]), same_plane.covariance, rtol=1e-12
        )
        assert all(np.array_equal(8.0 * a, b) for a, b in zip(plane.polygons_w, same_plane.polygons_w, strict=True))


@pytest.mark.parametrize("size", [0.01, 0.1, 20.0])
def test_a_world_of_any_size_is_tracked_as_a_room_is(room: SyntheticSource, frames: list[Frame], size: float) -> None:
    """Depth noise is as large a part of the world as in the room, and so is the error: 1.5 mm there."""
    assert ate_m(play(room, scaled(frames, size)), room, size) < 0.0015 * size


@pytest.mark.parametrize(("factor", "holes"), [(3.0, 0.0), (10.0, 0.4)])
def test_a_noisy_sensor_is_tracked_as_well_as_its_noise_allows(
    room: SyntheticSource, frames: list[Frame], factor: float, holes: float
) -> None:
    """An error grows in proportion to the noise, and with the root of how much depth is missing."""
    allowed_m = 0.0012 * factor / np.sqrt(1.0 - holes)
    slam = play(room, [noisier(frame, factor * 0.0015, holes) for frame in frames])
    assert ate_m(slam, room) < allowed_m


@pytest.mark.parametrize(("size", "noise", "per_m2", "unit_m"), [(1.0, 0.0, 0.0015, 1.0), (0.125, 0.12, 0.12, 0.25)])
def test_the_log_says_what_was_settled(
    room: SyntheticSource, frames: list[Frame], size: float, noise: float, per_m2: float, unit_m: float
) -> None:
    (first,) = scaled(frames[:1], size)
    report = Slam(room.camera, Config()).process_frame(noisier(first, noise, 0.0))
    assert report.measures["depth_sigma_per_m2"] == pytest.approx(per_m2, rel=0.3)
    assert report.measures["unit_m"] == unit_m


def test_noise_that_a_config_gives_is_not_learnt_anew(room: SyntheticSource, frames: list[Frame]) -> None:
    noisy = [noisier(frame, 0.015, 0.4) for frame in frames[:4]]
    slam = Slam(room.camera, load(None, ["loss.depth_sigma_per_m2=0.0015"]))
    statuses = [slam.process_frame(frame).status for frame in noisy]
    assert FrameStatus.LOST in statuses


def unusable(frame: Frame) -> Frame:
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


@pytest.mark.parametrize("spoil", [unusable, lambda frame: replace(frame, depth_m=frame.depth_m[:10])])
def test_a_first_frame_that_is_refused_settles_nothing(
    room: SyntheticSource, frames: list[Frame], spoil: Callable[[Frame], Frame]
) -> None:
    small = scaled(frames[:4], 0.125)
    slam, undisturbed = Slam(room.camera, Config()), play(room, small[1:])
    with pytest.raises(FrameError):
        slam.process_frame(spoil(small[0]))
    assert len(slam.trajectory()) == len(slam.gaussians()) == len(slam.keyframe_trajectory()) == 0
    for frame in small[1:]:
        slam.process_frame(frame)
    np.testing.assert_array_equal(slam.trajectory().T_wc, undisturbed.trajectory().T_wc)


def test_depth_in_whole_units_is_taken_as_well(room: SyntheticSource, frames: list[Frame]) -> None:
    def stored(frame: Frame) -> Frame:
        return replace(frame, depth_m=np.rint(frame.depth_m * 5000.0).astype(np.uint16), depth_scale=50_000.0)

    raw = [stored(frame) for frame in frames[:3]]
    metres = [replace(f, depth_m=f.depth_m.astype(np.float32) * np.float32(1 / 50_000), depth_scale=1.0) for f in raw]
    np.testing.assert_array_equal(play(room, raw).trajectory().T_wc, play(room, metres).trajectory().T_wc)
    with pytest.raises(FrameError, match="depth_scale"):
        Slam(room.camera, Config()).process_frame(replace(raw[0], depth_scale=1.0))


def test_millimetres_read_in_fifths_of_them_are_told(
    room: SyntheticSource, frames: list[Frame], caplog: pytest.LogCaptureFixture
) -> None:
    stored = np.rint(frames[0].depth_m * 1000.0).astype(np.uint16)
    Slam(room.camera, Config()).process_frame(replace(frames[0], depth_m=stored, depth_scale=5000.0))
    assert "dataset.depth_scale=1000 makes a room of it" in caplog.text
    caplog.clear()
    Slam(room.camera, Config()).process_frame(replace(frames[0], depth_m=stored, depth_scale=1000.0))
    assert not caplog.text


def test_a_world_that_is_no_room_is_told(
    room: SyntheticSource, frames: list[Frame], caplog: pytest.LogCaptureFixture
) -> None:
    (small,) = scaled(frames[:1], 0.03)
    Slam(room.camera, Config()).process_frame(small)
    assert "nothing beyond 0.1" in caplog.text and "unit_m" in caplog.text
    caplog.clear()
    Slam(room.camera, load(None, ["unit_m=0.0625"])).process_frame(small)
    assert not caplog.text
