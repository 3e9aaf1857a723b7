"""Renderings and recorded images as files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.errors import OutputError
from tgslam.files.atomic import atomic_file
from tgslam.types import FloatImage

DEPTH_SCALE = 5000.0  # units of a depth PNG per metre, as in the TUM RGB-D benchmark
_JPEG_QUALITY = 98  # the layouts that ask for JPEG are to lose next to nothing


def write_colour(path: Path, colour: FloatImage, small: bool = False) -> None:
    """Write RGB [H, W, 3] in [0, 1] as an 8-bit PNG, or as JPEG to a path that says so; values outside are clipped.

    small: take longer for a smaller PNG. Raises OSError.
    """
    rgb = np.round(np.clip(colour, 0.0, 1.0) * 255.0).astype(np.uint8)
    png = [cv2.IMWRITE_PNG_COMPRESSION, 9] if small else []
    _write_image(path, rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if path.suffix == ".jpg" else png)


def write_depth(path: Path, depth_m: FloatImage, scale: float = DEPTH_SCALE) -> None:
    """Write depth [H, W] m as a 16-bit PNG of `scale` units a metre.

    0 = no depth, which what has no place becomes too: what lies beyond 13.1 m by default. Raises OSError.
    """
    units = np.round(np.nan_to_num(depth_m, posinf=0.0) * scale)
    _write_image(path, np.where((units < 0) | (units > 65535), 0, units).astype(np.uint16))


def write_depth_colours(path: Path, depth_m: FloatImage, far_m: float) -> None:
    """Write depth [H, W] m for the eye: near is red, `far_m` and beyond is blue, no depth is black. Raises OSError."""
    nearness = np.clip(1.0 - depth_m / far_m, 0.0, 1.0)
    bgr = cv2.applyColorMap(np.round(nearness * 255.0).astype(np.uint8), cv2.COLORMAP_TURBO)
    _write_image(path, np.where((depth_m > 0)[..., None], bgr, np.uint8(0)).astype(np.uint8))


def _write_image(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16], options: Sequence[int] = ()) -> None:
    ok, data = cv2.imencode(path.suffix, np.ascontiguousarray(image), options)
    if not ok:
        raise OutputError(f"{path}: an image of shape {image.shape} cannot be written as {path.suffix[1:].upper()}")
    with atomic_file(path) as file:
        file.write(data.tobytes())
