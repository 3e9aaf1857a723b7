"""Decoding of colour and depth images, and removal of lens distortion."""

from __future__ import annotations

import contextlib
import io
import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.datasets import exr
from tgslam.datasets.image_header import MOST_PIXELS, check_claimed_size
from tgslam.errors import DatasetError, FrameError
from tgslam.pixels import depth_as_metres
from tgslam.types import FloatImage

_PNG_START, _PNG_END = b"\x89PNG", b"IEND"
_NPY_START = b"\x93NUMPY"
_SAMPLE_IMAGES = 4  # of a recording, that tell its colours' range
_MOST_BYTES = 1 << 30  # of an image file
_log = logging.getLogger(__name__)


def read_colour(path: Path, unused_bits: int = 0) -> NDArray[np.uint8]:
    """An image file -> [H, W, 3] RGB, 8 bits. Grey, 16-bit and alpha images are converted. Raises FrameError.

    unused_bits: highest bits of 16 that are always 0, as with 4 of a camera that gives 12; see `unused_bits`.
    """
    return decode_colour(_read(path), str(path), unused_bits)


def decode_colour(data: bytes, name: str, unused_bits: int = 0) -> NDArray[np.uint8]:
    """The bytes of an image file; see `read_colour`. name: for messages."""
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    bgr = _decode(data, name, flags | cv2.IMREAD_ANYDEPTH if unused_bits else flags)
    if bgr.dtype == np.uint16:
        bgr = np.minimum(bgr >> (8 - unused_bits), 255).astype(np.uint8)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def unused_bits(paths: Sequence[Path]) -> int:
    """How many of the highest bits no pixel of some 16-bit images uses; 0 for images of 8 bits.

    An even number, as cameras give 10, 12 or 14 bits; at least 8 are left. Images that cannot be read do not count.
    """
    most = 0
    for path in paths:
        with contextlib.suppress(FrameError):
            image = _decode(_read(path), str(path), cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
            if image.dtype != np.uint16:
                return 0
            most = max(most, int(image.max()))
    return min((16 - most.bit_length()) // 2 * 2, 8) if most else 0


def unused_bits_of_some(paths: Sequence[Path]) -> int:
    """See `unused_bits`; told by a few images of a recording, and logged."""
    some = paths[:: max(1, len(paths) // _SAMPLE_IMAGES)]
    bits = unused_bits(some)
    if bits:
        where, used = paths[0].parent, 16 - bits
        _log.warning("%s: colour uses %d of its 16 bits; it is read as if white were 2^%d", where, used, used)
    return bits


def read_raw_depth(path: Path) -> NDArray[Any]:
    """A depth file -> [H, W], 0 = no measurement: uint16 in the file's units, or float32 in metres.

    PNG, PGM and TIFF with 16 bits; TIFF, EXR and NPY with floats. Raises FrameError for anything else.
    """
    return decode_raw_depth(_read(path), str(path))


def decode_raw_depth(data: bytes, name: str) -> NDArray[Any]:
    """The bytes of a depth file; see `read_raw_depth`. name: for messages."""
    if data.startswith(_NPY_START):
        raw = _decode_npy(data, name)
    elif data.startswith(exr.START):
        raw = _decode_exr(data, name)
    else:
        raw = _decode(data, name, cv2.IMREAD_UNCHANGED)
    if raw.ndim == 3 and raw.shape[2] == 1:
        raw = raw[..., 0]
    if raw.ndim != 2:
        channels = raw.shape[2] if raw.ndim == 3 else raw.shape
        raise FrameError(f"{name}: a depth image has one channel, this has {channels}; are colour and depth swapped?")
    if raw.dtype.kind == "f":
        return np.ascontiguousarray(raw, np.float32)
    if raw.dtype != np.uint16:
        raise FrameError(
            f"{name}: a depth image has 16 bits, this has {8 * raw.itemsize}; export depth as 16-bit PNG, or as floats "
            "in metres (TIFF, EXR, NPY)"
        )
    return raw


def read_unchanged(path: Path) -> NDArray[Any]:
    """An image file with the channels, in OpenCV's order, and bits that it has. Raises FrameError."""
    return _decode(_read(path), str(path), cv2.IMREAD_UNCHANGED)


def size_of_first(paths: Sequence[Path]) -> tuple[int, int]:
    """Width and height of the first image of a recording that can be read. Raises DatasetError if none can."""
    first_error = ""
    for path in paths:
        try:
            height, width = read_unchanged(path).shape[:2]
        except FrameError as error:
            first_error = first_error or str(error)
        else:
            return width, height
    raise DatasetError(f"none of {len(paths)} images can be read; the first: {first_error}")


def depth_in_metres(raw: NDArray[Any], units_per_metre: float, min_m: float, max_m: float) -> FloatImage:
    """Raw depth [H, W] -> metres; values outside [min_m, max_m] become 0 (no measurement). Floats are metres."""
    if raw.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            return np.where((raw >= min_m) & (raw <= max_m), raw, np.float32(0.0))
    depth_m = depth_as_metres(raw, units_per_metre)
    low, high = math.ceil(min_m * units_per_metre - 1e-6), math.floor(max_m * units_per_metre + 1e-6)
    depth_m[(raw < low) | (raw > high)] = 0.0  # compared in whole units: exact at the limits
    return depth_m


class Undistorter:
    """Removes lens distortion and keeps the camera matrix; the sampling maps are computed once."""

    def __init__(self, width: int, height: int, K: NDArray[np.float64], distortion: tuple[float, ...]) -> None:
        """K: [3, 3] px (a negative fy is allowed); distortion: OpenCV's coefficients k1, k2, p1, p2, k3, ..."""
        coefficients = np.asarray(distortion, np.float64)
        maps = cv2.initUndistortRectifyMap(K, coefficients, None, K, (width, height), cv2.CV_32FC1)
        self._linear = cv2.convertMaps(*maps, cv2.CV_16SC2)
        self._nearest = cv2.convertMaps(*maps, cv2.CV_16SC2, nninterpolation=True)

    def colour(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """[H, W, 3], interpolated linearly; black where the lens saw nothing."""
        return cv2.remap(rgb, self._linear[0], self._linear[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)

    def depth(self, raw: NDArray[Any]) -> NDArray[Any]:
        """[H, W], nearest measurement: depths are never mixed across an edge. 0 where the lens saw nothing."""
        return cv2.remap(raw, self._nearest[0], self._nearest[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)


def _read(path: Path) -> bytes:
    try:
        size = path.stat().st_size
        data = path.read_bytes() if size <= _MOST_BYTES and path.is_file() else b""
    except (OSError, ValueError) as cause:
        raise FrameError(f"{path}: cannot be read ({getattr(cause, 'strerror', cause)})") from cause
    if not data:
        reason = "the file is empty; copy it again" if size == 0 else "not an image: a folder, a device or over a GiB"
        raise FrameError(f"{path}: {reason}")
    return data


def _decode(data: bytes, name: str, flags: int) -> NDArray[Any]:
    check_claimed_size(data, name)
    if data.startswith(_PNG_START) and _PNG_END not in data[-64:]:
        raise FrameError(f"{name}: the image is truncated at {len(data)} bytes; copy it again")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as cause:
        raise FrameError(f"{name}: not an image that can be decoded ({cause.code})") from cause
    if image is None:
        raise FrameError(f"{name}: damaged, or not an image")
    return image


def _decode_exr(data: bytes, name: str) -> NDArray[Any]:
    check_claimed_size(data, name)
    return exr.decode_exr_depth(data, name)


def _decode_npy(data: bytes, name: str) -> NDArray[Any]:
    """An array of NumPy; never one of pickled objects, and of no size that the file does not have."""
    file = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read_header(file)
        pixels = math.prod(shape)
        if dtype.hasobject or not 0 < pixels <= MOST_PIXELS or pixels * dtype.itemsize > len(data):
            raise ValueError(f"its {shape} numbers of {dtype} are not what the file holds")
        file.seek(0)
        return np.load(file, allow_pickle=False)
    except Exception as cause:  # its header is Python's syntax, whose parser raises what it likes
        raise FrameError(f"{name}: not an array of NumPy that can be read ({cause})") from cause
