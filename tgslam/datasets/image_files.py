"""Decoding of colour and depth images, and removal of lens distortion."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.errors import FrameError
from tgslam.pixels import depth_as_metres
from tgslam.types import FloatImage

_PNG_START, _PNG_END = b"\x89PNG", b"IEND"


def read_colour(path: Path, unused_bits: int = 0) -> NDArray[np.uint8]:
    """An image file -> [H, W, 3] RGB, 8 bits. Grey, 16-bit and alpha images are converted. Raises FrameError.

    unused_bits: highest bits of 16 that are always 0, as with 4 of a camera that gives 12; see `unused_bits`.
    """
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    bgr = _decode(path, flags | cv2.IMREAD_ANYDEPTH if unused_bits else flags)
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
            image = _decode(path, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
            if image.dtype != np.uint16:
                return 0
            most = max(most, int(image.max()))
    return min((16 - most.bit_length()) // 2 * 2, 8) if most else 0


def read_raw_depth(path: Path) -> NDArray[np.uint16]:
    """A depth image file -> [H, W] in the file's units, 0 = no measurement. Raises FrameError if not 16-bit grey."""
    raw = _decode(path, cv2.IMREAD_UNCHANGED)
    if raw.ndim != 2:
        raise FrameError(
            f"{path}: a depth image has one channel, this has {raw.shape[2]}; are colour and depth swapped?"
        )
    if raw.dtype != np.uint16:
        raise FrameError(f"{path}: a depth image has 16 bits, this has {8 * raw.itemsize}; export depth as 16-bit PNG")
    return raw


def depth_in_metres(raw: NDArray[np.uint16], units_per_metre: float, min_m: float, max_m: float) -> FloatImage:
    """Raw depth [H, W] -> metres; values outside [min_m, max_m] become 0 (no measurement)."""
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

    def depth(self, raw: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """[H, W], nearest measurement: depths are never mixed across an edge. 0 where the lens saw nothing."""
        return cv2.remap(raw, self._nearest[0], self._nearest[1], cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)


def _decode(path: Path, flags: int) -> NDArray:
    try:
        data = path.read_bytes()
    except OSError as cause:
        raise FrameError(f"{path}: cannot be read ({cause.strerror})") from cause
    if not data:
        raise FrameError(f"{path}: the file is empty; copy it again")
    if data.startswith(_PNG_START) and _PNG_END not in data[-64:]:
        raise FrameError(f"{path}: the image is truncated at {len(data)} bytes; copy it again")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as cause:
        raise FrameError(f"{path}: not an image that can be decoded ({cause.code})") from cause
    if image is None:
        raise FrameError(f"{path}: damaged, or not an image")
    return image
