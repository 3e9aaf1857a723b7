"""Where a sensor was saturated: colours there say nothing, and no exposure brings them back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

import cv2
import numpy as np

from tgslam.camera import Camera
from tgslam.device import runtime

WHOLE = 0.99  # share of some 6 x 6 pixels that is not saturated, from which on their colours count
_SATURATED = 254.5 / 255.0  # of any channel
_LEAST_SHARE = 0.1  # of an image; lamps, windows and glints take less, and mislead nobody
_SAMPLE_STEP_PX = 8


class _Sized(Protocol):
    @property
    def camera(self) -> Camera: ...


Level = TypeVar("Level", bound=_Sized)


def half_covers(colour: np.ndarray, levels: Sequence[Level]) -> list[tuple[Level, np.ndarray]]:
    """Each level with which share of its 2x2 pixels is not saturated, [H // 2, W // 2] on the device.

    colour: [H, W, 3] on the device. Nothing for an image in which next to nothing is saturated.
    """
    image = runtime.to_host(colour)
    sample = image[::_SAMPLE_STEP_PX, ::_SAMPLE_STEP_PX]
    if (sample >= _SATURATED).any(axis=2).mean() < _LEAST_SHARE:
        return []
    cover = (image < _SATURATED).all(axis=2).astype(np.float32)
    sizes = [(level.camera.width // 2, level.camera.height // 2) for level in levels]
    halves = [cv2.resize(cover, size, interpolation=cv2.INTER_AREA) for size in sizes]
    return [(level, runtime.to_device(half)) for level, half in zip(levels, halves, strict=True)]
