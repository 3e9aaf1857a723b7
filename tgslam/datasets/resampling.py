"""Images on another grid of pixels: depth on that of colour, and both at the width that a run asks for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.datasets.calibration import Calibration
from tgslam.errors import ConfigError

_FAR_PX = 1e6  # beyond any image
_EDGE = 0.05  # relative depth step between neighbours beyond which they are two surfaces


class Resampling:
    """Depth [h, w] looked up at places of its own pixels, one a column and one a row of the result.

    Between neighbours of one surface depth is interpolated. At edges it is the nearest pixel's, so that no depth comes
    out that was not measured. Places outside the image have none.
    """

    def __init__(self, columns: NDArray[Any], rows: NDArray[Any]) -> None:
        """columns [W], rows [H]: px of the image that is looked up."""
        self._columns, self._rows = (
            np.clip(places, -_FAR_PX, _FAR_PX).astype(np.float32) for places in (columns, rows)
        )

    def __call__(self, depth: NDArray[Any]) -> NDArray[Any]:
        """[h, w] of any kind of number -> [H, W] of the same."""
        height, width = depth.shape
        columns, rows = np.rint(self._columns).astype(int), np.rint(self._rows).astype(int)
        inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))[None]
        nearest = depth[np.clip(rows, 0, height - 1)][:, np.clip(columns, 0, width - 1)]
        smooth, one_surface = self._interpolated(depth)
        if depth.dtype.kind in "ui":
            smooth = np.rint(smooth)
        result = np.where(one_surface, smooth.astype(depth.dtype), nearest)
        return np.where(inside, result, depth.dtype.type(0))

    def _interpolated(self, depth: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Bilinear depth [H, W], and where the four pixels that it is of are one surface."""
        height, width = depth.shape
        left, top = np.floor(self._columns).astype(int), np.floor(self._rows).astype(int)
        across, down = (self._columns - left)[None], (self._rows - top)[:, None]
        x = [np.clip(left + k, 0, width - 1) for k in (0, 1)]
        y = [np.clip(top + k, 0, height - 1) for k in (0, 1)]
        a, b, c, d = (depth[rows][:, columns].astype(np.float32) for rows in y for columns in x)
        upper, lower = a + (b - a) * across, c + (d - c) * across
        least, most = np.minimum.reduce([a, b, c, d]), np.maximum.reduce([a, b, c, d])
        with np.errstate(invalid="ignore"):
            return upper + (lower - upper) * down, (least > 0) & (most - least <= _EDGE * least)


def in_view(depth: NDArray[Any], shape: tuple[int, int]) -> NDArray[Any]:
    """Depth [h, w] on a grid of `shape` (height, width) that shows the same in pixels of another size."""
    if depth.shape == shape:
        return depth
    rows, columns = ((np.arange(new) + 0.5) * (old / new) - 0.5 for new, old in zip(shape, depth.shape, strict=True))
    return Resampling(columns, rows)(depth)


class DepthResampler:
    """Depth of a camera at the place of the colour camera, looking the same way, on colour's grid of pixels."""

    def __init__(self, depth: Calibration, colour: Camera) -> None:
        """depth: of the stored depth images, with their size; without distortion."""
        assert depth.size is not None
        self.stored_shape = depth.size[1], depth.size[0]
        columns = (np.arange(colour.width) - colour.cx) / colour.fx * depth.fx + depth.cx
        rows = (np.arange(colour.height) - colour.cy) / colour.fy * depth.fy + depth.cy
        self._resampling = Resampling(columns, rows)

    def __call__(self, depth: NDArray[Any]) -> NDArray[Any]:
        """[h, w] -> [H, W]."""
        return self._resampling(depth)


class Resizer:
    """Makes colour smaller: the mean of the pixels that fall together."""

    def __init__(self, stored: Camera, width: int, name: str) -> None:
        """Raises ConfigError for a width beyond that of the stored images."""
        if width > stored.width:
            raise ConfigError(
                f"dataset.width is {width}, but the images of {name} are {stored.width} wide; they are not enlarged"
            )
        height = max(1, round(stored.height * width / stored.width))
        across, down = width / stored.width, height / stored.height
        self.camera = replace(
            stored,
            width=width,
            height=height,
            fx=stored.fx * across,
            fy=stored.fy * down,
            cx=(stored.cx + 0.5) * across - 0.5,
            cy=(stored.cy + 0.5) * down - 0.5,
        )

    def colour(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """[H, W, 3] -> of the camera's size."""
        return cv2.resize(rgb, (self.camera.width, self.camera.height), interpolation=cv2.INTER_AREA)
