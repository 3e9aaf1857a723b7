"""Bags of ROS 1 and ROS 2, MCAP, and RealSense's .bag, through the package rosbags.

Topics of colour and depth are told by the type and the encoding of what they hold, or named by the settings
dataset.expert.colour_topic and depth_topic. The camera is that of the CameraInfo beside them. Whole-number depth is in
millimetres (REP 118). Bags are read once when they are opened, for the times of the images; frames are read when they
are asked for.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets.calibration import Calibration, depth_camera, resolve
from tgslam.datasets.layout import Layout
from tgslam.datasets.layouts import ros_cameras as cameras
from tgslam.datasets.layouts import ros_images as messages
from tgslam.datasets.stored import MILLIMETRES, StoredRecording
from tgslam.datasets.time_matching import associate_times
from tgslam.errors import ConfigError, DatasetError, FrameError, TgslamError
from tgslam.types import Matrix4

_log = logging.getLogger(__name__)
_SUFFIXES = (".bag", ".mcap", ".db3")
_IMAGES = (messages.IMAGE, messages.COMPRESSED)
_CAMERA_INFO, _TRANSFORM, _TF = "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/Transform", "tf2_msgs/msg/TFMessage"
_UNITS = "/option/Depth_Units/value"


def open_ros(path: Path, config: DatasetConfig) -> StoredRecording:
    """A bag: a file, or a folder of ROS 2. Raises DatasetError for one that is damaged or holds no colour and depth."""
    bag = _Bag(_bag_in(path) or path)
    colour, depth = _choose(bag, config)
    _log.info("%s: colour is of %s, depth of %s", path, colour, depth)
    frames = _BagFrames(bag, colour, depth, config.expert.depth_tolerance_s)
    seen, measured = _calibration(bag, colour), _calibration(bag, depth)
    own = depth_camera(seen, measured, _motion(bag, colour, depth)) if seen and measured else None
    calibration = resolve(config, seen, f"{path}: holds no CameraInfo for {colour}")
    return StoredRecording(path.stem, frames, calibration, _units(bag), depth_camera=own)


class _Bag:
    """What is asked of an opened bag. What is wrong with it comes out as DatasetError, or FrameError for a frame."""

    def __init__(self, path: Path) -> None:
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise ConfigError(f"{path}: to read bags of ROS: pip install tgslam[ros]") from None
        self.path = path
        with self.guard(DatasetError, "not a bag that can be read"):
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
            self._reader.open()

    @contextmanager
    def guard(self, error: type[TgslamError], what: str) -> Iterator[None]:
        """The package raises exceptions of any kind for damaged bags."""
        try:
            yield
        except (TgslamError, OSError):
            raise
        except Exception as cause:
            raise error(
                f"{self.path}: {what} ({type(cause).__name__}: {' '.join(str(cause).split())[:120]})"
            ) from cause

    def topics(self, *types: str) -> list[str]:
        """Names of topics of these types that hold messages, in order."""
        found = (c for c in self._reader.connections if c.msgtype in types and c.msgcount)
        return sorted({connection.topic for connection in found})

    def raw(self, topic: str, start_ns: int | None = None) -> Iterator[tuple[Any, int, bytes]]:
        """(connection, time in ns, bytes) of a topic's messages in order of the times at which they were recorded."""
        connections = [c for c in self._reader.connections if c.topic == topic]
        return self._reader.messages(connections=connections, start=start_ns)

    def decoded(self, connection: Any, data: bytes) -> Any:
        return self._reader.deserialize(data, connection.msgtype)

    def stamp_ns(self, data: bytes) -> int:
        """Of a message that begins with a header: when it was taken; 0 = it does not say."""
        seconds, nanoseconds = struct.unpack_from("<iI" if self._reader.is2 else "<II", data, 4)
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def first(self, topic: str | None) -> Any:
        """A topic's first message; None without one."""
        if topic is None:
            return None
        with self.guard(DatasetError, f"{topic} cannot be read"):
            for connection, _, data in self.raw(topic):
                return self.decoded(connection, data)
        return None


def _choose(bag: _Bag, config: DatasetConfig) -> tuple[str, str]:
    """Topics of colour and of depth."""
    kinds: dict[str, str] = {}
    for topic in bag.topics(*_IMAGES):
        first = bag.first(topic)
        kinds[topic] = "" if first is None else messages.kind_of(first)
    given = (("colour", config.expert.colour_topic), ("depth", config.expert.depth_topic))
    for kind, topic in given:
        if topic and topic not in kinds:
            raise ConfigError(
                f"{bag.path}: holds no images of topic {topic!r} for dataset.expert.{kind}_topic; it has "
                f"{', '.join(kinds) or 'none at all'}"
            )
    depths = [topic for topic, kind in kinds.items() if kind == "depth"]
    colours = [topic for topic, kind in kinds.items() if kind == "colour"]
    colours = colours or [topic for topic, kind in kinds.items() if kind == "grey"]
    colour, depth = (topic for _, topic in given)
    if not (colour or colours) or not (depth or depths):
        missing = "colour" if depths else "depth" if colours else "colour and no depth"
        raise DatasetError(
            f"{bag.path}: holds no {missing} images (sensor_msgs/Image or CompressedImage); its image topics are "
            f"{', '.join(kinds) or 'none'}"
        )
    return colour or min(colours, key=_colour_rank), depth or min(depths, key=_depth_rank)


def _colour_rank(topic: str) -> tuple[bool, bool, int, str]:
    """Small = likely the colour of an RGB-D camera, as it was taken."""
    name = topic.lower()
    return not any(word in name for word in ("color", "colour", "rgb")), "infra" in name, len(name), name


def _depth_rank(topic: str) -> tuple[bool, int, str]:
    """Small = likely depth that is registered to colour."""
    name = topic.lower()
    return not any(word in name for word in ("aligned", "registered")), len(name), name


def _calibration(bag: _Bag, image_topic: str) -> Calibration | None:
    """Of the CameraInfo whose topic is called most alike; None without any."""
    info = bag.first(cameras.nearest_topic(bag.topics(_CAMERA_INFO), image_topic))
    return None if info is None else cameras.calibration_of(info, image_topic, f"{bag.path}: {image_topic}")


def _motion(bag: _Bag, colour: str, depth: str) -> Matrix4 | None:
    """T_colour_depth; None where the bag does not say."""
    from_reference = [topic for topic in bag.topics(_TRANSFORM) if "/tf/" in topic]
    if from_reference:
        to_colour, to_depth = (bag.first(cameras.nearest_topic(from_reference, topic)) for topic in (colour, depth))
        return np.asarray(cameras.matrix_of(to_colour) @ np.linalg.inv(cameras.matrix_of(to_depth)))
    frames = cameras.StaticFrames()
    for topic in (topic for topic in bag.topics(_TF) if topic.endswith("tf_static")):
        with bag.guard(DatasetError, f"{topic} cannot be read"):
            for connection, _, data in bag.raw(topic):
                for one in bag.decoded(connection, data).transforms:
                    frames.add(one.header.frame_id, one.child_frame_id, cameras.matrix_of(one.transform))
    return frames.between(bag.first(colour).header.frame_id, bag.first(depth).header.frame_id)


def _units(bag: _Bag) -> float:
    """Units of whole-number depth in a metre."""
    topic = next((topic for topic in bag.topics("std_msgs/msg/Float32") if topic.endswith(_UNITS)), None)
    metres = float(getattr(bag.first(topic), "data", 0.0))
    return 1.0 / metres if 1e-6 < metres < 1.0 else MILLIMETRES


class _Series:
    """Images of one topic: when each was taken, s, and recorded, ns. Reading goes on from where it last was."""

    def __init__(self, bag: _Bag, topic: str) -> None:
        self.bag, self.topic = bag, topic
        with bag.guard(DatasetError, f"{topic} cannot be read to its end"):
            found = [(bag.stamp_ns(data), time_ns) for _, time_ns, data in bag.raw(topic)]
        stamps = np.array(found, np.int64).reshape(-1, 2)
        if not stamps[:, 0].all():  # some drivers do not say
            stamps[:, 0] = stamps[:, 1]
        self._recorded_ns = stamps[:, 1]
        self._order = np.argsort(stamps[:, 0], kind="stable")
        self.times_s = stamps[self._order, 0] * 1e-9
        self._next = -1
        self._messages: Iterator[tuple[Any, int, bytes]] = iter(())

    def message(self, index: int) -> Any:
        """Number `index` in order of the times at which they were taken. Raises FrameError."""
        place = int(self._order[index])
        with self.bag.guard(FrameError, f"{self.topic}: image {index} cannot be read"):
            if place != self._next:
                self._seek(place)
            self._next = place + 1
            connection, _, data = next(self._messages)
            return self.bag.decoded(connection, data)

    def _seek(self, place: int) -> None:
        """To a place in the order of recording; several messages may have one time."""
        time_ns = int(self._recorded_ns[place])
        self._messages = self.bag.raw(self.topic, time_ns)
        for _ in range(place - int(np.searchsorted(self._recorded_ns, time_ns))):
            next(self._messages)


class _BagFrames:
    """See `StoredFrames`."""

    def __init__(self, bag: _Bag, colour: str, depth: str, tolerance_s: float) -> None:
        self._series = _Series(bag, colour), _Series(bag, depth)
        times = [series.times_s for series in self._series]
        i, j = associate_times(times[0], times[1], tolerance_s)
        later = np.concatenate([[True], np.diff(times[0][i]) > 0]) if len(i) else np.zeros(0, bool)
        self._places = i[later], j[later]
        if not len(self._places[0]):
            raise DatasetError(
                f"{bag.path}: no image of {depth} is within {tolerance_s:g} s of one of {colour}; raise "
                "dataset.expert.depth_tolerance_s"
            )

    @property
    def times_s(self) -> Sequence[float]:
        return [float(time_s) for time_s in self._series[0].times_s[self._places[0]]]

    def names(self, index: int) -> tuple[str, str]:
        colour, depth = (
            f"{series.bag.path}: {series.topic}: image {places[index]}"
            for series, places in zip(self._series, self._places, strict=True)
        )
        return colour, depth

    def colour(self, index: int) -> NDArray[np.uint8]:
        return messages.colour_of(self._series[0].message(int(self._places[0][index])), self.names(index)[0])

    def depth(self, index: int) -> NDArray[Any]:
        return messages.depth_of(self._series[1].message(int(self._places[1][index])), self.names(index)[1])


def _bag_in(path: Path) -> Path | None:
    """The bag that a path is, or that a folder holds as its only one."""
    if path.is_file():
        return path if path.suffix.lower() in _SUFFIXES else None
    if (path / "metadata.yaml").is_file() and any(path.glob("*.db3")) | any(path.glob("*.mcap")):
        return path
    found = sorted(file for file in path.glob("*") if file.suffix.lower() in _SUFFIXES)
    return found[0] if len(found) == 1 else None


ROS = Layout("ros", "*.bag, *.mcap, *.db3", lambda path: _bag_in(path) is not None, open_ros, is_file=True)
