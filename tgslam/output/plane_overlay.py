"""Images with the planes that they show: colours, outlines, ids and a legend."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tgslam.types import FloatImage, Plane

Bytes = NDArray[np.uint8]  # [H, W, 3] RGB: OpenCV writes on nothing else

_BLEND = 0.5  # share of a plane's colour
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_BLACK, _WHITE = (0, 0, 0), (255, 255, 255)
_LEAST_SCALE = 0.4  # of the font: smaller is not legible
_FULL_HEIGHT_PX = 960  # of an image with font scale 1
_LEAST_LABEL_PX = 3.0  # from an id's place to the nearest edge of what it stands on


def plane_overlay(colour: FloatImage, ids: NDArray[np.int32], planes: Sequence[Plane]) -> FloatImage:
    """The image [H, W, 3] with its planes by `ids` [H, W] (-1 = none), and at its right a legend: [H, W + L, 3] RGB."""
    image = with_planes(colour, ids, planes)
    legend = _legend(_shown(ids, planes), image.shape[0], _font_scale(image))
    drawn = np.concatenate([image, legend], axis=1)
    return drawn.astype(np.float32) / np.float32(255.0)


def with_planes(colour: FloatImage, ids: NDArray[np.int32], planes: Sequence[Plane]) -> Bytes:
    """The image [H, W, 3] RGB, with the planes that `ids` [H, W] show (-1 = none) in their colours, and their ids."""
    blended = np.clip(colour, 0.0, 1.0)
    shown = _shown(ids, planes)
    for plane in shown:
        mask = ids == plane.id
        blended[mask] = (1.0 - _BLEND) * blended[mask] + _BLEND * np.array(plane.colour, np.float32)
    image = as_bytes(blended)
    for plane in shown:
        mask = (ids == plane.id).astype(np.uint8)
        outlines = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(image, outlines, -1, as_bytes(plane.colour).tolist(), 1)
        _print_id(image, mask, str(plane.id), _font_scale(image))
    return image


def print_text(image: Bytes, text: str, middle: tuple[int, int], scale: float) -> None:
    """Print white text with a black rim round a place (x, y) px of the image."""
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, 1)
    left, bottom = middle[0] - width // 2, middle[1] + height // 2
    for right, down in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        cv2.putText(image, text, (left + right, bottom + down), _FONT, scale, _BLACK, 1, cv2.LINE_AA)
    cv2.putText(image, text, (left, bottom), _FONT, scale, _WHITE, 1, cv2.LINE_AA)


def as_bytes(colour: ArrayLike) -> NDArray[np.uint8]:
    """Colours in [0, 1] as 8-bit numbers."""
    return np.round(np.asarray(colour) * 255.0).astype(np.uint8)


def _shown(ids: NDArray[np.int32], planes: Sequence[Plane]) -> list[Plane]:
    return [plane for plane in planes if (ids == plane.id).any()]


def _font_scale(image: Bytes) -> float:
    return max(_LEAST_SCALE, image.shape[0] / _FULL_HEIGHT_PX)


def _print_id(image: Bytes, mask: NDArray[np.uint8], text: str, scale: float) -> None:
    """Print the id at the place in the mask that is farthest from its edges, if that is wide enough."""
    depth_px = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(depth_px)), mask.shape)
    if depth_px[row, column] < _LEAST_LABEL_PX:
        return
    print_text(image, text, (int(column), int(row)), scale)


def _legend(planes: Sequence[Plane], height: int, scale: float) -> Bytes:
    """[H, L, 3]: a row for each plane with its colour, id and area, as far as there is room."""
    row_px = round(36 * scale)
    legend = np.full((height, round(230 * scale), 3), 255, np.uint8)
    for number, plane in enumerate(planes[: height // row_px]):
        top = number * row_px
        legend[top + 1 : top + row_px - 1, 1:row_px] = _BLACK
        legend[top + 2 : top + row_px - 2, 2 : row_px - 1] = as_bytes(plane.colour)
        text = f"{plane.id}: {plane.area_m2:.2f} m2"
        cv2.putText(legend, text, (row_px + 4, top + round(0.72 * row_px)), _FONT, scale, _BLACK, 1, cv2.LINE_AA)
    return legend
