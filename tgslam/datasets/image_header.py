"""The size that an image file says it has, read before anything is decoded: a small file may claim a huge image."""

from __future__ import annotations

import struct

from tgslam.errors import FrameError

MOST_PIXELS = 1 << 26  # 8192 x 8192
_JPEG_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # markers that come with the size
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257


def check_claimed_size(data: bytes, name: str) -> None:
    """Raise FrameError for a PNG, JPEG, TIFF or EXR of more than 67 million pixels."""
    size = claimed_size(data)
    if size is not None and (min(size) < 1 or size[0] * size[1] > MOST_PIXELS):
        raise FrameError(
            f"{name}: claims to be {size[0]}x{size[1]} px; images of up to {MOST_PIXELS / 1e6:.0f} million are read"
        )


def claimed_size(data: bytes) -> tuple[int, int] | None:
    """Width and height, or None where the file is of another kind or damaged: then the decoder has its own checks."""
    readers = {b"\x89PNG": _png, b"\xff\xd8": _jpeg, b"II*\0": _tiff, b"MM\0*": _tiff, b"v/1\x01": _exr}
    for start, reader in readers.items():
        if data.startswith(start):
            try:
                return reader(data)
            except (struct.error, IndexError, OverflowError):
                return None
    return None


def _png(data: bytes) -> tuple[int, int]:
    width, height = struct.unpack_from(">II", data, 16)
    return width, height


def _jpeg(data: bytes) -> tuple[int, int] | None:
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return width, height
        alone = marker == 0xFF or marker == 0x01 or 0xD0 <= marker <= 0xD8
        at += (1 if marker == 0xFF else 2) if alone else 2 + int(struct.unpack_from(">H", data, at + 2)[0])
    return None


def _tiff(data: bytes) -> tuple[int, int] | None:
    order = "<" if data.startswith(b"II") else ">"
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    found: dict[int, int] = {}
    for k in range(count):
        tag, kind = struct.unpack_from(order + "HH", data, at + 2 + 12 * k)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
            (found[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, at + 10 + 12 * k)
    return (found[_TIFF_WIDTH], found[_TIFF_HEIGHT]) if len(found) == 2 else None


def _exr(data: bytes) -> tuple[int, int] | None:
    at = data.find(b"dataWindow\0box2i\0")
    if at < 0:
        return None
    left, top, right, bottom = struct.unpack_from("<iiii", data, at + 21)
    return right - left + 1, bottom - top + 1
