"""A frame made ready: of the right size, without flying pixels, as device arrays."""

from __future__ import annotations

from dataclasses import replace

from tgslam.camera import Camera, SensorNoise
from tgslam.device import runtime
from tgslam.errors import FrameError
from tgslam.ops.depth import measured_share, without_flying_pixels, without_range_limit
from tgslam.types import Frame

_MIN_DEPTH_SHARE = 0.01  # a frame with depth in fewer of its pixels is not usable


class Preparation:
    """What is done to every frame first."""

    def __init__(self, camera: Camera, noise: SensorNoise) -> None:
        self._camera, self._noise = camera, noise

    def __call__(self, frame: Frame) -> Frame:
        """The frame without flying pixels, as device arrays. Raises FrameError for a frame that cannot be used."""
        size = self._camera.shape
        if frame.depth_m.shape != size or frame.colour.shape != (*size, 3):
            raise FrameError(f"frame {frame.index}: images of {frame.depth_m.shape} do not fit the camera's {size}")
        in_range = without_range_limit(frame.depth_m, self._noise.per_m2)
        depth_m = without_flying_pixels(runtime.to_device(in_range), self._noise.per_m2, self._camera.fx)
        if measured_share(depth_m) < _MIN_DEPTH_SHARE:
            raise FrameError(f"frame {frame.index}: depth in less than {_MIN_DEPTH_SHARE:.0%} of its pixels")
        return replace(frame, colour=runtime.to_device(frame.colour), depth_m=depth_m)
