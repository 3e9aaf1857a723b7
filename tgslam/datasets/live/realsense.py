"""Intel RealSense cameras by `pyrealsense2`: colour, and depth that the library brings into colour's pixels."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any

import numpy as np

from tgslam.datasets.calibration import Calibration
from tgslam.datasets.live.sent_frame import Announcement, SentFrame
from tgslam.errors import DatasetError

_log = logging.getLogger(__name__)
_SIZE, _RATE_HZ = (640, 480), 30  # which all models have, of colour and of depth
_LONGEST_WAIT_MS = 5000
_MS = 1e-3


class RealSenseFeed:
    """Frames from the camera with a serial number, or from the only one; see `Feed`."""

    def __init__(self, serial: str = "") -> None:
        """Starts the camera. Raises DatasetError where the library or the camera is missing."""
        rs = _library()
        streams = rs.config()
        if serial:
            streams.enable_device(serial)
        streams.enable_stream(rs.stream.color, *_SIZE, rs.format.rgb8, _RATE_HZ)
        streams.enable_stream(rs.stream.depth, *_SIZE, rs.format.z16, _RATE_HZ)
        self._pipeline = rs.pipeline()
        try:
            profile = self._pipeline.start(streams)
        except RuntimeError as cause:
            which = f"no RealSense camera {serial}" if serial else "no RealSense camera"
            raise DatasetError(
                f"{which} could be started ({cause}); is it plugged into USB 3, and not in use?"
            ) from cause
        self._align: Callable[[Any], Any] = rs.align(rs.stream.color).process
        self._count = 0
        intrinsics = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        size = (int(intrinsics.width), int(intrinsics.height))
        calibration = Calibration(
            intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy, _distortion(rs, intrinsics), size
        )
        unit_m = profile.get_device().first_depth_sensor().get_depth_scale()
        units = float(f"{1.0 / unit_m:.6g}")  # as it comes in single precision
        self.announcement = Announcement("realsense", size, size, calibration, units)

    def next(self) -> SentFrame | None:
        """See `Feed.next`."""
        while True:
            try:
                both = self._align(self._pipeline.wait_for_frames(_LONGEST_WAIT_MS))
            except RuntimeError as cause:
                raise DatasetError(f"realsense: the camera gives no more frames ({cause})") from cause
            colour, depth = both.get_color_frame(), both.get_depth_frame()
            if colour and depth:
                break
        images = [np.array(image.get_data()) for image in (colour, depth)]  # copies: the library uses its own again
        self._count += 1
        decoded = [functools.partial(np.asarray, image) for image in images]
        return SentFrame(self._count - 1, _MS * colour.get_timestamp(), decoded[0], decoded[1])

    def close(self) -> None:
        """Stop the camera."""
        try:
            self._pipeline.stop()
        except RuntimeError as cause:  # it is unplugged, or stopped already
            _log.debug("realsense: %s", cause)


def _library() -> Any:
    try:
        import pyrealsense2
    except ImportError as cause:
        raise DatasetError(
            f'a RealSense camera needs pyrealsense2 ({cause}): pip install "tgslam[realsense]"'
        ) from cause
    return pyrealsense2


def _distortion(rs: Any, intrinsics: Any) -> tuple[float, ...]:
    """In OpenCV's order, whose model is Brown and Conrady's; its inverse is taken for the same, as ROS does."""
    coefficients = tuple(float(value) for value in intrinsics.coeffs)
    if not any(coefficients):
        return ()
    if intrinsics.model in (rs.distortion.brown_conrady, rs.distortion.inverse_brown_conrady):
        return coefficients
    _log.warning("realsense: distortion of the model %s is left out", intrinsics.model)
    return ()
