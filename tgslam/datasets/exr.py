"""OpenEXR images of depth, without a library: scan lines, uncompressed or compressed by ZIP.

Format: https://openexr.com/en/latest/OpenEXRFileLayout.html. OpenCV reads EXR only where it was built so.
"""

from __future__ import annotations

import struct
import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tgslam.datasets.image_header import MOST_PIXELS
from tgslam.errors import FrameError

START = b"v/1\x01"
_TILED, _DEEP, _MULTIPART = 0x200, 0x800, 0x1000
_TYPES: dict[int, np.dtype[Any]] = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}
_ROWS_OF_BLOCK = {0: 1, 2: 1, 3: 16}  # by compression: none, ZIPS, ZIP
_PREFERRED = ("Z", "Y", "R", "V")  # channels that depth is called by


class _Header(NamedTuple):
    channels: list[tuple[str, np.dtype[Any]]]
    compression: int
    width: int
    height: int
    top: int
    end: int  # where the table of offsets begins


def decode_exr_depth(data: bytes, name: str) -> NDArray[np.float32]:
    """[H, W] of the channel Z, Y, R or V, or else the first one. Raises FrameError. name: for messages."""
    try:
        header = _read_header(data)
        return _read_blocks(data, header)
    except (struct.error, ValueError, KeyError, IndexError, OverflowError, zlib.error) as cause:
        raise FrameError(
            f"{name}: not an EXR that can be read ({cause}); scan lines without compression or with ZIP are, or store "
            "depth as TIFF or NPY"
        ) from cause


def _read_header(data: bytes) -> _Header:
    (version,) = struct.unpack_from("<I", data, 4)
    if version & (_TILED | _DEEP | _MULTIPART):
        raise ValueError("tiled, deep, or of several parts")
    at, attributes = 8, dict[str, bytes]()
    while data[at] != 0:
        key, at = _text(data, at)
        _, at = _text(data, at)
        (size,) = struct.unpack_from("<I", data, at)
        attributes[key] = data[at + 4 : at + 4 + size]
        at += 4 + size
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    if min(width, height) < 1 or width * height > MOST_PIXELS:
        raise ValueError(f"{width}x{height} px")
    compression = attributes["compression"][0]
    if compression not in _ROWS_OF_BLOCK:
        raise ValueError(f"compression {compression}")
    return _Header(_channels(attributes["channels"]), compression, width, height, top, at + 1)


def _channels(value: bytes) -> list[tuple[str, np.dtype[Any]]]:
    found: list[tuple[str, np.dtype[Any]]] = []
    at = 0
    while value[at] != 0:
        name, at = _text(value, at)
        kind, _, across, down = struct.unpack_from("<iIii", value, at)
        if (across, down) != (1, 1):
            raise ValueError("channels of fewer pixels")
        found.append((name, _TYPES[kind]))
        at += 16
    if not found:
        raise ValueError("no channels")
    return found


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(b"\0", at)
    return data[at:end].decode("latin-1"), end + 1


def _read_blocks(data: bytes, header: _Header) -> NDArray[np.float32]:
    rows_of_block = _ROWS_OF_BLOCK[header.compression]
    blocks = -(-header.height // rows_of_block)
    names = [name for name, _ in header.channels]
    wanted = next((names.index(name) for name in _PREFERRED if name in names), 0)
    sizes = [header.width * dtype.itemsize for _, dtype in header.channels]
    before, row_bytes = sum(sizes[:wanted]), sum(sizes)
    image = np.zeros((header.height, header.width), np.float32)
    for offset in struct.unpack_from(f"<{blocks}Q", data, header.end):
        y, size = struct.unpack_from("<ii", data, offset)
        first = y - header.top
        rows = min(rows_of_block, header.height - first)
        if not 0 <= first < header.height or size < 0:
            raise ValueError(f"a block of row {y}")
        raw = _unpacked(data[offset + 8 : offset + 8 + size], rows * row_bytes)
        lines = np.frombuffer(raw, np.uint8).reshape(rows, row_bytes)[:, before : before + sizes[wanted]]
        image[first : first + rows] = np.ascontiguousarray(lines).view(header.channels[wanted][1])
    return image


def _unpacked(block: bytes, size: int) -> bytes:
    """A block that is not smaller than its pixels holds them as they are."""
    if len(block) == size:
        return block
    packed = np.frombuffer(zlib.decompressobj().decompress(block, size), np.uint8)
    if len(packed) != size:
        raise ValueError(f"a block of {len(packed)} bytes, expected {size}")
    steps = packed.astype(np.int64)
    steps[1:] -= 128  # bytes are differences, and even ones come before odd ones
    halves = (np.cumsum(steps) & 255).astype(np.uint8)
    result = np.empty(size, np.uint8)
    result[0::2], result[1::2] = halves[: (size + 1) // 2], halves[(size + 1) // 2 :]
    return result.tobytes()
