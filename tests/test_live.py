"""Frames that come while a run goes on: the stream's bytes, what is dropped, the commands, and a fake RealSense."""

from __future__ import annotations

import io
import json
import logging
import os
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fakes import CAMERA, FakeSource, FakeSystem, make_fake_show
from tgslam.cli import engine, inputs, main
from tgslam.config.input_settings import DatasetConfig
from tgslam.conversion.playing import play
from tgslam.datasets.calibration import Calibration
from tgslam.datasets.live.endpoints import is_live, loopback
from tgslam.datasets.live.latest_frames import KEPT, LatestFrames
from tgslam.datasets.live.live_source import LiveSource
from tgslam.datasets.live.realsense import RealSenseFeed
from tgslam.datasets.live.sent_frame import SentFrame
from tgslam.datasets.live.stream_format import StreamReader, frame_bytes, header_line
from tgslam.errors import ConfigError, DatasetError, FrameError, TgslamError
from tgslam.types import Frame
from tools import markdown_block

HEADER = {
    **{"tgslam": 1, "name": "desk", "width": 24, "height": 16, "fx": 20, "fy": 20, "cx": 11.5, "cy": 7.5},
    **{"depth_scale": 1000, "lossless": True},
}


def played(source: Any) -> bytes:
    file = io.BytesIO()
    play(source, file)
    return file.getvalue()


def live(data: bytes, config: DatasetConfig | None = None) -> LiveSource:
    return LiveSource(StreamReader(io.BytesIO(data).readinto, "pipe"), config or DatasetConfig())


def taken(data: bytes, config: DatasetConfig | None = None) -> list[Frame | FrameError]:
    return list(live(data, config).frames())


def line(**changes: Any) -> bytes:
    values = {key: value for key, value in {**HEADER, **changes}.items() if value is not None}
    return json.dumps(values).encode() + b"\n"


def packed(time_s: float, colour: bytes, depth: bytes) -> bytes:
    return b"FRAM" + struct.pack("<IId", len(colour), len(depth), time_s) + colour + depth


def images(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (16, 24, 3), np.uint8), rng.integers(500, 9000, (16, 24), np.uint16)


def raw_frame(time_s: float, seed: int = 0) -> bytes:
    colour, depth = images(seed)
    return packed(time_s, colour.tobytes(), depth.astype("<u2").tobytes())


def png(image: np.ndarray, kind: str = ".png") -> bytes:
    return cv2.imencode(kind, image)[1].tobytes()


def test_eight_bit_colour_and_depth_come_back_to_the_bit() -> None:
    colour, depth = images()
    data = line() + raw_frame(1.5)
    (frame,) = taken(data)
    assert isinstance(frame, Frame)
    again = io.BytesIO(header_line("desk", CAMERA, lossless=True) + frame_bytes(frame))
    (second,) = taken(again.getvalue())
    assert isinstance(second, Frame)
    for one in (frame, second):
        np.testing.assert_array_equal(np.round(one.colour * 255), colour)
        np.testing.assert_allclose(one.depth_m, depth / 1000.0, rtol=1e-6)
        assert one.timestamp_s == 1.5
    np.testing.assert_array_equal(frame.depth_m, second.depth_m)


@pytest.mark.parametrize(("kind", "off"), [(".png", 1e-4), (".jpg", 3.0)])
def test_images_may_be_files(kind: str, off: float) -> None:
    _, depth = images()
    colour = np.dstack([np.tile(np.linspace(first, 200, 24), (16, 1)) for first in (0, 90, 250)]).astype(np.uint8)
    data = line(colour="image", depth="image") + packed(0.0, png(colour[..., ::-1], kind), png(depth))
    (frame,) = taken(data)
    assert isinstance(frame, Frame)
    assert np.abs(frame.colour * 255 - colour).mean() <= off
    np.testing.assert_allclose(frame.depth_m, depth / 1000.0, rtol=1e-6)


def test_settings_count_as_they_do_for_recordings() -> None:
    config = DatasetConfig(depth_scale=2000.0, fx=30.0, max_depth_m=2.0, width=12)
    source = live(line(depth_scale=None) + raw_frame(0.0), config)
    assert (source.camera.width, source.camera.fx) == (12, 15.0)
    (frame,) = source.frames()
    assert isinstance(frame, Frame)
    assert frame.depth_m.shape == (8, 12)
    assert frame.depth_m[frame.depth_m > 0].min() >= 0.25 and frame.depth_m.max() <= 2.0


BAD_HEADERS: dict[str, tuple[bytes, str]] = {
    "none": (b"", "cut off in its first line"),
    "no json": (b"hello\n", "not JSON"),
    "no end": (b"x" * 70_000, "first line is over"),
    "another version": (line(tgslam=2), '"tgslam": 1'),
    "unknown key": (line(hight=3), "hight: not known"),
    "no width": (line(width=None), "expected a number as 'width'"),
    "huge": (line(width=16384, height=16384), "no images of width"),
    "no whole size": (line(width=0.5), "no images of width"),
    "beyond floats": (line(fx=10**400), "expected a number as 'fx'"),
    "half a camera": (line(cy=None), "expected a number as 'cy'"),
    "no camera": (line(fx=None, fy=None, cx=None, cy=None), "camera is not known"),
    "no camera that can be": (line(fx=-3), "dataset.fx is -3"),
    "distortion": (line(distortion=[1, 2]), "distortion has 2 values"),
    "packing": (line(colour="bgr8"), "colour must be one of rgb8, image"),
    "no unit": (line(depth_scale=None), "unit of depth"),
    "unit": (line(depth_scale=0), "depth_scale is 0"),
    "lossless": (line(lossless="yes"), "lossless must be"),
    "another shape": (line(depth_width=10, depth_height=16), "shapes differ"),
}


@pytest.mark.parametrize(("data", "message"), BAD_HEADERS.values(), ids=BAD_HEADERS)
def test_a_first_line_that_cannot_be_is_told(data: bytes, message: str) -> None:
    with pytest.raises((DatasetError, ConfigError), match=message):
        live(data)


BROKEN = {
    "in a head": (raw_frame(0.2)[:11], "cut off in the head of frame 2, after 11 of 20 bytes"),
    "in an image": (raw_frame(0.2)[:-5], "cut off in frame 2"),
    "out of step": (b"\nprinted by mistake: 12345\n", "no frame begins where frame 2 should"),
    "too long": (packed(0.2, bytes(24 * 16 * 3 + 1), b""), r"colour of frame 2 has 1,153 bytes, over 1,152"),
}


@pytest.mark.parametrize(("rest", "message"), BROKEN.values(), ids=BROKEN)
def test_a_stream_that_breaks_off_ends_with_what_came(
    rest: bytes, message: str, caplog: pytest.LogCaptureFixture
) -> None:
    frames = taken(line() + raw_frame(0.0) + raw_frame(0.1) + rest)
    assert [frame.index for frame in frames if isinstance(frame, Frame)] == [0, 1]
    assert f"ends after 2 frames: pipe: {message}".replace(r"\ ", " ") in caplog.text


def test_without_a_frame_there_is_nothing() -> None:
    with pytest.raises(DatasetError, match="desk: no frame came"):
        taken(line())
    with pytest.raises(DatasetError, match="no frame came: pipe: cut off"):
        taken(line() + b"FRA")


def test_a_frame_that_cannot_be_used_is_one_frame() -> None:
    colour, depth = images()
    small = png(colour[:8])
    bad = {
        packed(0.1, png(colour)[:90], png(depth)): "frame 1: colour: .*truncated",
        packed(0.1, b"", png(depth)): "frame 1: colour: is empty",
        packed(0.1, small, png(depth)): "24x8, but|24x16, but",
        packed(0.1, png(colour), png(colour)): "has one channel",
        packed(float("nan"), png(colour), png(depth)): "time of frame 1 is nan",
    }
    for data, message in bad.items():
        good = [packed(time_s, png(colour), png(depth)) for time_s in (0.0, 0.2)]
        first, error, last = taken(line(colour="image", depth="image") + good[0] + data + good[1])
        assert isinstance(first, Frame) and isinstance(last, Frame) and last.index == 2
        with pytest.raises(FrameError, match=message):
            raise error  # type: ignore[misc]
    short = taken(line() + raw_frame(0.0) + packed(0.1, b"12", b"34"))
    assert "has 2 bytes; 24x16 px need 1,152" in str(short[1])


VALID = line(colour="image", depth="image", lossless=True) + b"".join(
    packed(0.1 * k, png(images(k)[0]), png(images(k)[1])) for k in range(3)
)


@settings(max_examples=40)
@given(st.lists(st.tuples(st.integers(0, len(VALID) - 1), st.integers(0, 255)), max_size=6), st.integers(0, 400))
def test_spoilt_bytes_never_surprise(changes: list[tuple[int, int]], cut: int) -> None:
    data = bytearray(VALID)
    for place, value in changes:
        data[place] = value
    try:
        frames = taken(bytes(data[: len(data) - cut]))
    except TgslamError:
        return
    assert 1 <= len(frames) <= 3


def numbered(number: int) -> SentFrame:
    return SentFrame(number, 0.1 * number, lambda: images()[0], lambda: images()[1])


def test_the_oldest_are_dropped_and_counted() -> None:
    latest = LatestFrames(lossless=False)
    assert all(latest.put(numbered(k)) for k in range(10))
    latest.end()
    left = list(iter(lambda: latest.take(lambda: False), None))
    assert [frame.number for frame in left if frame] == list(range(10 - KEPT, 10))
    assert (latest.came, latest.dropped) == (10, 10 - KEPT)


def test_a_run_that_is_slow_gets_the_latest_frames(caplog: pytest.LogCaptureFixture) -> None:
    begun = io.BytesIO(line(lossless=False) + raw_frame(0.0))
    more = io.BytesIO(b"".join(raw_frame(0.1 * k, k) for k in range(1, 10)))
    first_is_taken = threading.Event()

    def receive(view: memoryview) -> int:
        got = begun.readinto(view)
        if not got:
            assert first_is_taken.wait(5.0)
        return got or more.readinto(view)

    source = LiveSource(StreamReader(receive, "pipe"), DatasetConfig())
    caplog.set_level(logging.INFO)
    frames = source.frames()
    first = next(frames)
    first_is_taken.set()
    for thread in threading.enumerate():
        if thread.name == "live-frames":
            thread.join(5.0)
    rest = list(frames)
    source.close()
    assert isinstance(first, Frame) and len(rest) == KEPT
    times_s = [frame.timestamp_s for frame in rest if isinstance(frame, Frame)]
    assert times_s == pytest.approx([0.8, 0.9])
    assert [frame.index for frame in (first, *rest) if isinstance(frame, Frame)] == [0, 1, 2]
    assert source.dropped == 10 - 1 - KEPT
    assert f"desk: 10 frames came, {source.dropped} of them were dropped" in caplog.text


def test_the_page_says_how_a_frame_is_sent() -> None:
    page = (Path(__file__).resolve().parents[1] / "docs" / "live.md").read_text()
    (snippet,) = markdown_block.blocks(page, "python")
    (header,) = markdown_block.blocks(page, "json")
    names: dict[str, Any] = {}
    exec(snippet, names)
    told, file, (rgb, depth) = json.loads(header), io.BytesIO(), images()
    names["send"](file, 2.0, rgb, depth)
    (frame,) = taken(
        json.dumps({**told, "width": 24, "height": 16, "cx": 11, "cy": 7}).encode() + b"\n" + file.getvalue()
    )
    assert isinstance(frame, Frame) and frame.timestamp_s == 2.0
    np.testing.assert_array_equal(np.round(frame.depth_m * 1000), depth)


def test_nothing_is_dropped_where_who_sends_waits() -> None:
    latest = LatestFrames(lossless=True)
    sender = threading.Thread(target=lambda: [latest.put(numbered(k)) for k in range(10)], daemon=True)
    sender.start()
    taken_now = []
    for _ in range(10):
        time.sleep(0.002)
        assert latest.came <= len(taken_now) + KEPT
        frame = latest.take(lambda: False)
        assert frame is not None
        taken_now.append(frame.number)
    assert taken_now == list(range(10)) and latest.dropped == 0
    blocked = threading.Thread(target=lambda: [latest.put(numbered(k)) for k in range(10)], daemon=True)
    blocked.start()
    latest.close()
    blocked.join(5.0)
    assert not blocked.is_alive()


def test_a_request_to_stop_ends_the_wait() -> None:
    assert LatestFrames(lossless=False).take(lambda: True) is None


def test_addresses() -> None:
    assert [is_live(text) for text in ("-", "tcp://127.0.0.1:5000", "realsense:", "./-", "folder")] == [
        *(True, True, True, False, False)
    ]
    assert loopback("tcp://127.0.0.1:5000") == ("127.0.0.1", 5000)
    assert loopback("tcp://localhost:1") == ("127.0.0.1", 1)
    assert loopback("tcp://[::1]:9") == ("::1", 9)
    for text in ("tcp://192.168.0.7:5000", "tcp://example.org:80", "tcp://0.0.0.0:80"):
        with pytest.raises(ConfigError, match="only this machine"):
            loopback(text)
    for text in ("tcp:127.0.0.1:5", "tcp://127.0.0.1", "tcp://127.0.0.1:99999", "tcp://127.0.0.1:5/x", "tcp://[::1"):
        with pytest.raises(ConfigError, match="expected tcp://127"):
            loopback(text)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[SimpleNamespace]:
    """The commands with a fake system and, where a recording is opened, a fake one."""
    world = SimpleNamespace(source=FakeSource(6), system=FakeSystem())
    monkeypatch.setattr(inputs, "open_source", lambda dataset, synthetic, seed, input_dir: world.source)
    monkeypatch.setattr(engine, "start_device", lambda name, threads=0: "cpu")
    monkeypatch.setattr(engine, "make_system", lambda camera, config: world.system)
    monkeypatch.setattr(
        engine, "make_show", lambda camera, gaussians, planes, config: make_fake_show(gaussians, planes)
    )
    monkeypatch.chdir(tmp_path)
    logger = logging.getLogger("tgslam")
    before = list(logger.handlers), logger.level, logger.propagate
    yield world
    logger.handlers[:], logger.level, logger.propagate = before


def run_with(data: bytes, monkeypatch: pytest.MonkeyPatch, *more: str) -> int:
    Path("stream").write_bytes(data)
    with Path("stream").open("rb") as file:
        monkeypatch.setattr(sys, "stdin", file)
        return main(["run", "--input", "-", "--output", "out", *more])


def metrics() -> dict[str, Any]:
    return json.loads(Path("out/metrics.json").read_text())


def one_error(capsys: pytest.CaptureFixture[str]) -> str:
    (found,) = [text for text in capsys.readouterr().err.splitlines() if "error:" in text]
    return found


def test_run_reads_standard_input(
    world: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["convert", "--to", "stream", "--output", "sent"]) == 0
    assert run_with(Path("sent").read_bytes()[:-7], monkeypatch) == 0
    err = capsys.readouterr().err
    assert "cut off in frame 5" in err and "5 frames came, 0 of them were dropped" in err
    assert "the image metrics are null: frames that came live cannot be read again" in err
    assert [frame.index for frame in world.system.frames] == list(range(5))
    for k, frame in enumerate(world.system.frames):
        np.testing.assert_array_equal(frame.depth_m, world.source.read(k).depth_m)
        assert frame.timestamp_s == world.source.read(k).timestamp_s
    found = metrics()
    assert (found["state"], found["frames"], found["psnr_db"], found["ate_rmse_cm"]) == ("finished", 5, None, None)
    assert Path("out/map.ply").exists() and world.system.finished
    assert json.loads(Path("out/run.json").read_text())["input"] == "-"
    log = [json.loads(text) for text in Path("out/log.jsonl").read_text().splitlines()]
    assert [report["measures"]["dropped"] for report in log] == [0.0] * 5
    assert main(["eval", "out"]) == 1
    assert "came live" in one_error(capsys)
    Path("truth.txt").write_text("".join(f"{0.1 * k} {k} 0 {k * k} 0 0 0 1\n" for k in range(6)))
    assert main(["eval", "out", "--groundtruth", "truth.txt"]) == 0
    assert metrics()["ate_rmse_all_cm"] is not None


def test_run_takes_frames_from_a_socket(world: SimpleNamespace, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        where = f"tcp://127.0.0.1:{free.getsockname()[1]}"

    def send() -> None:
        for _ in range(200):
            try:
                connection = socket.create_connection(loopback(where))
                break
            except OSError:
                time.sleep(0.01)
        with connection, connection.makefile("wb") as file:
            play(FakeSource(6), file)

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    assert main(["run", "--input", where, "--output", "out"]) == 0
    sender.join(5.0)
    assert len(world.system.frames) == 6 and metrics()["state"] == "finished"
    assert "waits for who sends frames" in capsys.readouterr().err
    assert main(["convert", "--to", "stream", "--output", where]) == 1
    assert "nobody listens there" in one_error(capsys)


def test_ctrl_c_ends_the_wait_for_frames(world: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    world.system.on_frame = lambda index: os.kill(os.getpid(), 2) if index == 2 else None
    os.write(writing, played(FakeSource(3)))  # and then nothing, though the pipe stays open
    with os.fdopen(reading, "rb") as file, os.fdopen(writing, "wb"):
        monkeypatch.setattr(sys, "stdin", file)
        assert main(["run", "--input", "-", "--output", "out"]) == 130
    assert (metrics()["state"], metrics()["frames"], world.system.finished) == ("interrupted", 3, False)


def test_what_does_not_go_with_live_frames(
    world: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = played(FakeSource(3))
    Path("poses").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    for more, message in {
        ("--frames", "1:"): "--frames does not go",
        ("--poses", "poses"): "poses without times",
        ("--poses", "recording"): "no poses of its own",
    }.items():
        assert run_with(data, monkeypatch, *more) in (1, 2)
        assert message in one_error(capsys)
    assert run_with(line(), monkeypatch) == 1
    assert "no frame came" in one_error(capsys)
    assert json.loads(Path("out/run.json").read_text())["state"] == "failed"
    assert main(["convert", "--to", "tum", "--output", "x", "--live"]) == 2
    assert "--live goes with" in one_error(capsys)


class FakeRealSense(SimpleNamespace):
    """As much of `pyrealsense2` as is used: one camera, with `count` frames, of which some have no depth."""

    def __init__(self, count: int, without_depth: tuple[int, ...] = ()) -> None:
        super().__init__()
        self.stream = SimpleNamespace(color="color", depth="depth")
        self.format = SimpleNamespace(rgb8="rgb8", z16="z16")
        self.distortion = SimpleNamespace(brown_conrady=4, inverse_brown_conrady=2)
        self.asked: list[Any] = []
        self.count, self.without_depth, self.given, self.stopped = count, without_depth, 0, False

    def config(self) -> Any:
        return SimpleNamespace(enable_device=self.asked.append, enable_stream=lambda *stream: self.asked.append(stream))

    def pipeline(self) -> Any:
        return SimpleNamespace(start=self._start, wait_for_frames=self._wait, stop=self._stop)

    def align(self, to: str) -> Any:
        assert to == "color"
        return SimpleNamespace(process=lambda frames: frames)

    def _start(self, config: Any) -> Any:
        if not self.count:
            raise RuntimeError("No device connected")
        intrinsics = SimpleNamespace(
            width=24, height=16, fx=20.0, fy=20.0, ppx=11.5, ppy=7.5, coeffs=[0.1, 0, 0, 0, 0], model=4
        )
        video = SimpleNamespace(get_intrinsics=lambda: intrinsics)
        sensor = SimpleNamespace(get_depth_scale=lambda: float(np.float32(0.001)))
        return SimpleNamespace(
            get_stream=lambda stream: SimpleNamespace(as_video_stream_profile=lambda: video),
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
        )

    def _wait(self, timeout_ms: int) -> Any:
        if self.given == self.count:
            raise RuntimeError("Frame didn't arrive within 5000")
        number, self.given = self.given, self.given + 1
        colour, depth = np.full((16, 24, 3), 40, np.uint8), np.full((16, 24), 1500, np.uint16)
        image: Callable[[Any], Any] = lambda array: SimpleNamespace(  # noqa: E731
            get_data=lambda: array, get_timestamp=lambda: 1000.0 + 33.0 * number
        )
        return SimpleNamespace(
            get_color_frame=lambda: image(colour),
            get_depth_frame=lambda: None if number in self.without_depth else image(depth),
        )

    def _stop(self) -> None:
        self.stopped = True


def test_a_realsense_camera(
    world: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    library = FakeRealSense(4, without_depth=(1,))
    monkeypatch.setitem(sys.modules, "pyrealsense2", library)
    feed = RealSenseFeed()
    assert feed.announcement.calibration == Calibration(20.0, 20.0, 11.5, 7.5, (0.1, 0.0, 0.0, 0.0, 0.0), (24, 16))
    assert feed.announcement.depth_units == 1000.0
    sent = [feed.next() for _ in range(3)]
    assert [(one.number, one.timestamp_s) for one in sent if one] == [(0, 1.0), (1, 1.066), (2, 1.099)]
    with pytest.raises(DatasetError, match="gives no more frames"):
        feed.next()
    library.given, library.asked = 0, []
    assert main(["run", "--input", "realsense:1234", "--output", "out"]) == 0
    assert library.asked == ["1234", ("color", 640, 480, "rgb8", 30), ("depth", 640, 480, "z16", 30)]
    assert library.stopped
    assert "gives no more frames" in capsys.readouterr().err
    last = world.system.frames[-1]
    assert last.timestamp_s == pytest.approx(1.099)
    assert 1 <= len(world.system.frames) <= 3
    np.testing.assert_allclose(last.depth_m[4:12, 6:18], 1.5, rtol=1e-6)
    np.testing.assert_allclose(last.colour[4:12, 6:18], 40 / 255, rtol=1e-6)


def test_without_the_library_or_a_camera(
    world: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    assert main(["run", "--input", "realsense:", "--output", "out"]) == 1
    assert 'pip install "tgslam[realsense]"' in one_error(capsys)
    monkeypatch.setitem(sys.modules, "pyrealsense2", FakeRealSense(0))
    assert main(["run", "--input", "realsense:", "--output", "out"]) == 1
    assert "no RealSense camera could be started (No device connected)" in one_error(capsys)
