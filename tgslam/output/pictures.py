"""Renderings as PNG files."""

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


def write_colour(path: Path, colour: FloatImage, small: bool = False) -> None:
    """Write RGB [H, W, 3] in [0, 1] as an 8-bit PNG; values outside are clipped. Raises OSError.

    small: take longer for a smaller file.
    """
    rgb = np.round(np.clip(colour, 0.0, 1.0) * 255.0).astype(np.uint8)
    _write_png(path, rgb[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9] if small else [])


def write_depth(path: Path, depth_m: FloatImage) -> None:
    """Write depth [H, W] m as a 16-bit PNG of `DEPTH_SCALE` units a metre.

    0 = no depth, which what lies beyond 13.1 m becomes too. Raises OSError.
    """
    units = np.round(np.nan_to_num(depth_m, posinf=0.0) * DEPTH_SCALE)
    _write_png(path, np.where((units < 0) | (units > 65535), 0, units).astype(np.uint16))


def write_depth_colours(path: Path, depth_m: FloatImage, far_m: float) -> None:
    """Write depth [H, W] m for the eye: near is red, `far_m` and beyond is blue, no depth is black. Raises OSError."""
    nearness = np.clip(1.0 - depth_m / far_m, 0.0, 1.0)
    bgr = cv2.applyColorMap(np.round(nearness * 255.0).astype(np.uint8), cv2.COLORMAP_TURBO)
    _write_png(path, np.where((depth_m > 0)[..., None], bgr, np.uint8(0)).astype(np.uint8))


def _write_png(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16], options: Sequence[int] = ()) -> None:
    ok, data = cv2.imencode(".png", np.ascontiguousarray(image), options)
    if not ok:
        raise OutputError(f"{path}: an image of shape {image.shape} cannot be written as PNG")
    with atomic_file(path) as file:
        file.write(data.tobytes())
