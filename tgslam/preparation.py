"""What a frame goes through before anything looks at it."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.boundary import FrameCheck
from tgslam.camera import Camera, SensorNoise
from tgslam.device import runtime
from tgslam.errors import FrameError
from tgslam.ops.depth import measured_share, without_flying_pixels
from tgslam.types import Frame

_MIN_DEPTH_SHARE = 0.01  # a frame with depth in fewer of its pixels is not usable
_RANGE_SIGMAS = 3.0  # nearer to the farthest measurement than this, noise decides what is in range
_RANGE_WINDOW_PX = 17  # much wider than the seams without depth along edges
_RANGE_SHARE = 0.85  # of the window that has depth; then a surface reads at most 0.3 sigma too near


class Preparation:
    """Drops what is no measurement of a surface, and takes frames to the device."""

    def __init__(self, camera: Camera, noise: SensorNoise) -> None:
        self._camera, self._noise, self._check = camera, noise, FrameCheck(camera)

    def __call__(self, frame: Frame) -> Frame:
        """The frame without flying pixels, as device arrays. Raises FrameError for a frame that cannot be used."""
        frame = self._check(frame)
        in_range = without_range_limit(frame.depth_m, self._noise)
        depth_m = without_flying_pixels(runtime.to_device(in_range), self._noise, self._camera.fx)
        if measured_share(depth_m) < _MIN_DEPTH_SHARE:
            raise FrameError(f"frame {frame.index}: depth in less than {_MIN_DEPTH_SHARE:.0%} of its pixels")
        self._check.accept(frame)
        return replace(frame, colour=runtime.to_device(frame.colour), depth_m=depth_m)


def without_range_limit(depth_m: NDArray[np.float32], noise: SensorNoise) -> NDArray[np.float32]:
    """Drop the measurements of surfaces that are partly out of the sensor's range.

    Of such a surface a sensor gives those pixels that noise brings near, up to 2 sigma too near in the mean. They are
    told by pixels without depth around them, among what is as far as the farthest measurement but for noise.
    depth_m: [H, W], 0 = none. Returns a new array.
    """
    far_m = float(depth_m.max(initial=0.0))
    limit = depth_m > far_m - _RANGE_SIGMAS * noise.per_m2 * far_m**2
    share = cv2.blur((depth_m > 0).astype(np.float32), (_RANGE_WINDOW_PX, _RANGE_WINDOW_PX))
    return np.where(limit & (share < _RANGE_SHARE), np.float32(0.0), depth_m)
