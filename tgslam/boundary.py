"""Frames at the boundary of the system: what programs hand over, checked once and made float32."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.errors import FrameError
from tgslam.pixels import colour_as_float, depth_as_metres
from tgslam.types import FloatImage, Frame

_MOST_COLOUR = 1.5  # images in [0, 1] may overshoot a little, as after resizing; those in [0, 255] are far beyond
_FARTHEST_M = 200.0  # median depth: no RGB-D sensor sees so far, but millimetres read as metres do
_STEP_PX = 8  # every n-th pixel and row tells the median


class FrameCheck:
    """Frames must fit the camera and come in order of time."""

    def __init__(self, camera: Camera) -> None:
        self._shape = camera.shape
        self._last_s = -np.inf

    def __call__(self, frame: Frame) -> Frame:
        """The frame with float32 images in [0, 1] and in metres.

        Raises FrameError, which says what to change, for another shape or dtype, for values that can only be in other
        units, and for a time that is not after that of the last frame that `accept` was told of.
        """
        if not self._last_s < frame.timestamp_s:
            raise FrameError(
                f"frame {frame.index}: its time, {frame.timestamp_s} s, is not after the last frame's, {self._last_s} s"
            )
        colour, depth_m = self._colour(frame), self._depth_m(frame)
        return dataclasses.replace(frame, colour=colour, depth_m=depth_m, depth_scale=1.0)

    def accept(self, frame: Frame) -> None:
        """The system has taken the frame: those to come must be later."""
        self._last_s = frame.timestamp_s

    def _colour(self, frame: Frame) -> FloatImage:
        colour = self._image(frame, "colour", frame.colour, (*self._shape, 3))
        if colour.dtype == np.uint8:
            return colour_as_float(colour)
        _require_float(frame, "colour", colour, "uint8 or float in [0, 1]")
        least, most = float(colour.min()), float(colour.max())
        if not (least >= 1.0 - _MOST_COLOUR and most <= _MOST_COLOUR):  # also for NaN
            raise FrameError(
                f"frame {frame.index}: colour goes from {least:g} to {most:g}; float colour is in [0, 1]: divide by "
                "255, or hand it over as uint8"
            )
        return np.ascontiguousarray(colour, np.float32)

    def _depth_m(self, frame: Frame) -> FloatImage:
        depth = self._image(frame, "depth_m", frame.depth_m, self._shape)
        if not 0.0 < frame.depth_scale < np.inf:
            raise FrameError(f"frame {frame.index}: depth_scale is {frame.depth_scale}, but must be above 0")
        if depth.dtype == np.uint16:
            if frame.depth_scale == 1.0:
                raise FrameError(
                    f"frame {frame.index}: depth of uint16 needs depth_scale, its units in a metre: 1000 for "
                    "millimetres, 5000 for the TUM benchmark"
                )
        else:
            _require_float(frame, "depth_m", depth, "float in metres, or uint16 with depth_scale")
        scaled = frame.depth_scale != 1.0
        depth_m = depth_as_metres(depth, frame.depth_scale) if scaled else np.ascontiguousarray(depth, np.float32)
        measured = np.isfinite(depth_m) & (depth_m > 0)
        if not measured.all():
            depth_m = np.where(measured, depth_m, np.float32(0.0))
        sample = depth_m[::_STEP_PX, ::_STEP_PX]
        median_m = float(np.median(sample[sample > 0])) if sample.any() else 0.0
        if median_m > _FARTHEST_M:
            raise FrameError(
                f"frame {frame.index}: depth is {median_m:,.0f} m in the median; if it is in millimetres, hand it over "
                "with depth_scale=1000"
            )
        return depth_m

    def _image(self, frame: Frame, name: str, image: Any, shape: tuple[int, ...]) -> NDArray[Any]:
        if not isinstance(image, np.ndarray) or image.shape != shape:
            found = list(image.shape) if isinstance(image, np.ndarray) else type(image).__name__
            raise FrameError(f"frame {frame.index}: {name} must be an array of shape {list(shape)}, but is {found}")
        return image


def _require_float(frame: Frame, name: str, image: NDArray[Any], allowed: str) -> None:
    if image.dtype not in (np.float32, np.float64, np.float16):
        raise FrameError(f"frame {frame.index}: {name} of {image.dtype} is not known; give {allowed}")
