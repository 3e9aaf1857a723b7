"""The stream of bytes by which another process hands over frames; docs/live.md describes it.

A line of JSON says what comes. Then each frame is a head of 20 bytes, little-endian (`FRAM`, bytes of colour and of
depth as uint32, time in s as float64), colour, and depth.
"""

from __future__ import annotations

import functools
import json
import math
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.datasets import image_files as images
from tgslam.datasets import json_files
from tgslam.datasets.calibration import DISTORTION_LENGTHS, Calibration
from tgslam.datasets.image_header import MOST_PIXELS
from tgslam.datasets.live.sent_frame import Announcement, SentFrame
from tgslam.datasets.stored import RawDepth
from tgslam.errors import DatasetError, FrameError
from tgslam.types import Frame

VERSION = 1
_INTRINSICS = ("fx", "fy", "cx", "cy")
_KEYS = {
    *("tgslam", "name", "width", "height", "distortion", "colour", "depth", "depth_width", "depth_height"),
    *("depth_scale", "lossless", *_INTRINSICS),
}
_COLOURS = {"rgb8": 3}  # bytes a pixel; besides, "image": an image file
_DEPTHS = {"uint16": 2, "float32": 4}
_IMAGE = "image"
_HEAD = struct.Struct("<4sIId")
_START = b"FRAM"
_MOST_HEADER = 1 << 16
_MOST_SIDE = 16384
_MOST_IMAGE = (8, 1 << 16)  # bytes of an image file: so many a pixel, and so many in any case

Receive = Callable[[memoryview], int]  # fills a part of it and says how much; 0 at the end; raises OSError


@dataclass(frozen=True)
class Header:
    """The first line: what is known of all frames, and how they are packed."""

    announcement: Announcement
    colour: str
    depth: str


class StreamReader:
    """Frames out of bytes, each checked against the header. What is too long or out of step ends the stream."""

    def __init__(self, receive: Receive, where: str, on_close: Callable[[], None] = lambda: None) -> None:
        """Reads the header. Raises DatasetError for one that says nothing usable. where: for messages."""
        self._receive, self._where, self._on_close = receive, where, on_close
        self.header = parse_header(self._first_line(), where)
        told = self.header.announcement
        self._most = (
            _most_bytes(told.size, _COLOURS.get(self.header.colour)),
            _most_bytes(told.depth_size, _DEPTHS.get(self.header.depth)),
        )
        self._count = 0

    @property
    def announcement(self) -> Announcement:
        """See `Feed.announcement`."""
        return self.header.announcement

    def close(self) -> None:
        """See `Feed.close`."""
        self._on_close()

    def next(self) -> SentFrame | None:
        """See `Feed.next`."""
        number = self._count
        head = self._exactly(_HEAD.size, f"the head of frame {number}", may_end=True)
        if head is None:
            return None
        start, *lengths, timestamp_s = _HEAD.unpack(head)
        if start != _START:
            raise DatasetError(
                f"{self._where}: no frame begins where frame {number} should; is something else printed?"
            )
        for what, length, most in zip(("colour", "depth"), lengths, self._most, strict=True):
            if length > most:
                raise DatasetError(f"{self._where}: {what} of frame {number} has {length:,} bytes, over {most:,}")
        colour, depth = (self._exactly(length, f"frame {number}") or bytearray() for length in lengths)
        self._count += 1
        told, name = self.header.announcement, f"{self._where}: frame {number}"
        return SentFrame(
            number,
            timestamp_s,
            functools.partial(_colour, colour, self.header.colour, told.size, f"{name}: colour"),
            functools.partial(_depth, depth, self.header.depth, told.depth_size, f"{name}: depth"),
        )

    def _first_line(self) -> bytes:
        line = bytearray()
        while not line.endswith(b"\n"):
            byte = self._exactly(1, "its first line")
            line += byte or b""
            if len(line) > _MOST_HEADER:
                raise DatasetError(f"{self._where}: its first line is over {_MOST_HEADER:,} bytes; it must be JSON")
        return bytes(line)

    def _exactly(self, length: int, what: str, *, may_end: bool = False) -> bytearray | None:
        """So many bytes; None where the stream ended before the first of them, if it may."""
        data = bytearray(length)
        view, filled = memoryview(data), 0
        while filled < length:
            got = self._receive(view[filled:])
            if not got and may_end and not filled:
                return None
            if not got:
                raise DatasetError(f"{self._where}: cut off in {what}, after {filled:,} of {length:,} bytes")
            filled += got
        return data


def parse_header(line: bytes, where: str) -> Header:
    """Raises DatasetError, which names the key."""
    values, name = json_files.parse_object(line, f"{where}: first line"), f"{where}: first line"
    if values.get("tgslam") != VERSION:
        raise DatasetError(f'{name}: expected "tgslam": {VERSION}, the version of the stream')
    unknown = sorted(set(values) - _KEYS)
    if unknown:
        raise DatasetError(f"{name}: {', '.join(unknown)[:80]}: not known; known are {', '.join(sorted(_KEYS))}")
    size = _size(values, "width", "height", name)
    depth_size = _size(values, "depth_width", "depth_height", name) if "depth_width" in values else size
    calibration = None
    if any(key in values for key in _INTRINSICS):
        fx, fy, cx, cy = (json_files.number(values, key, name) for key in _INTRINSICS)
        calibration = Calibration(fx, fy, cx, cy, _distortion(values, name), size)
    colour, depth = (
        _packing(values, "colour", "rgb8", _COLOURS, name),
        _packing(values, "depth", "uint16", _DEPTHS, name),
    )
    units = json_files.number(values, "depth_scale", name) if "depth_scale" in values else None
    if units is not None and units <= 0:
        raise DatasetError(f"{name}: depth_scale is {units:g}, but must be above 0: units in a metre")
    lossless = values.get("lossless", False)
    if not isinstance(lossless, bool):
        raise DatasetError(f"{name}: lossless must be true or false")
    told = Announcement(_name(values), size, depth_size, calibration, units, depth == "float32", lossless)
    return Header(told, colour, depth)


def header_line(name: str, camera: Camera, *, lossless: bool) -> bytes:
    """The first line of a stream of frames as the system takes them: 8-bit colour, and depth in metres."""
    values: dict[str, Any] = {"tgslam": VERSION, "name": name, "width": camera.width, "height": camera.height}
    values |= {key: getattr(camera, key) for key in _INTRINSICS}
    values |= {"colour": "rgb8", "depth": "float32", "lossless": lossless}
    return json.dumps(values).encode() + b"\n"


def frame_bytes(frame: Frame) -> bytes:
    """A frame with float images, as `header_line` announces it."""
    colour = np.round(np.clip(frame.colour, 0.0, 1.0) * 255.0).astype(np.uint8).tobytes()
    depth = np.ascontiguousarray(frame.depth_m, "<f4").tobytes()
    return _HEAD.pack(_START, len(colour), len(depth), frame.timestamp_s) + colour + depth


def _most_bytes(size: tuple[int, int], pixel_bytes: int | None) -> int:
    """Of an image; pixel_bytes: None = it is an image file."""
    pixels = size[0] * size[1]
    return pixels * pixel_bytes if pixel_bytes is not None else pixels * _MOST_IMAGE[0] + _MOST_IMAGE[1]


def _colour(data: bytearray, packing: str, size: tuple[int, int], name: str) -> NDArray[np.uint8]:
    if packing == _IMAGE:
        return images.decode_colour(_not_empty(data, name), name)
    return np.frombuffer(_whole(data, size, _COLOURS[packing], name), np.uint8).reshape(size[1], size[0], 3)


def _depth(data: bytearray, packing: str, size: tuple[int, int], name: str) -> RawDepth:
    if packing == _IMAGE:
        return images.decode_raw_depth(_not_empty(data, name), name)
    kind = "<u2" if packing == "uint16" else "<f4"
    raw = np.frombuffer(_whole(data, size, _DEPTHS[packing], name), kind)
    return raw.reshape(size[1], size[0]).astype(raw.dtype.newbyteorder("="), copy=False)


def _not_empty(data: bytearray, name: str) -> bytes:
    if not data:
        raise FrameError(f"{name}: is empty")
    return bytes(data)


def _whole(data: bytearray, size: tuple[int, int], pixel_bytes: int, name: str) -> bytearray:
    expected = math.prod(size) * pixel_bytes
    if len(data) != expected:
        raise FrameError(f"{name}: has {len(data):,} bytes; {size[0]}x{size[1]} px need {expected:,}")
    return data


def _size(values: dict[str, Any], across: str, down: str, name: str) -> tuple[int, int]:
    width, height = (json_files.number(values, key, name) for key in (across, down))
    sides_fit = all(side.is_integer() and 1 <= side <= _MOST_SIDE for side in (width, height))
    if not sides_fit or width * height > MOST_PIXELS:
        raise DatasetError(f"{name}: no images of {across} {width:g} and {down} {height:g} px are read")
    return int(width), int(height)


def _packing(values: dict[str, Any], key: str, usual: str, known: dict[str, int], name: str) -> str:
    found = values.get(key, usual)
    if found not in (*known, _IMAGE):
        raise DatasetError(f"{name}: {key} must be one of {', '.join((*known, _IMAGE))}, not {str(found)[:60]!r}")
    return str(found)


def _distortion(values: dict[str, Any], name: str) -> tuple[float, ...]:
    found = json_files.numbers(values, "distortion", name, (-1,)) if values.get("distortion") else np.zeros(0)
    if len(found) and len(found) not in DISTORTION_LENGTHS:
        raise DatasetError(f"{name}: distortion has {len(found)} values; OpenCV's models have {DISTORTION_LENGTHS}")
    return tuple(float(value) for value in found)


def _name(values: dict[str, Any]) -> str:
    """What the sender calls itself, if folders may be called so."""
    name = values.get("name")
    return name if isinstance(name, str) and re.fullmatch(r"\w[\w.-]{0,63}", name) else "live"
