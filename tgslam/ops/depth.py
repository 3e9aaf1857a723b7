"""What the sensor's depth image has too much of: flying pixels, and the end of its range."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import depth as kernels
from tgslam.kernels.image import SPLIT

_TOLERANCE_SIGMAS = 4.2  # three sigma of a difference of two measurements
_STEEPEST = 5.7  # tangent of 80 degrees
_MIN_NEIGHBOURS = 4
_RANGE_SIGMAS = 3.0  # nearer to the farthest measurement than this, noise decides what is in range
_RANGE_WINDOW_PX = 17  # much wider than the seams without depth along edges
_RANGE_SHARE = 0.85  # of the window that has depth; then a surface reads at most 0.3 sigma too near


def without_flying_pixels(depth_m: np.ndarray, sigma_per_m2: float, focal_px: float) -> np.ndarray:
    """Drop measurements that fewer than half of their neighbours support: sensors interpolate across edges.

    depth_m: float32 [H, W], 0 = none. sigma_per_m2: sensor noise, sigma_z = this * z^2. Returns a new [H, W] array.
    """
    require("depth_m", depth_m, (None, None))
    kept = runtime.empty(depth_m.shape)
    kernels.keep_supported(depth_m, sigma_per_m2, _TOLERANCE_SIGMAS, _STEEPEST / focal_px, _MIN_NEIGHBOURS, kept)
    return kept


def without_range_limit(depth_m: NDArray[np.float32], sigma_per_m2: float) -> NDArray[np.float32]:
    """Drop the measurements of surfaces that are partly out of the sensor's range.

    Of such a surface a sensor gives those pixels that noise brings near, up to 2 sigma too near in the mean. They are
    told by pixels without depth around them, among what is as far as the farthest measurement but for noise.
    depth_m: [H, W], 0 = none. sigma_per_m2: sensor noise, sigma_z = this * z^2. Returns a new array.
    """
    far_m = float(depth_m.max(initial=0.0))
    limit = depth_m > far_m - _RANGE_SIGMAS * sigma_per_m2 * far_m**2
    share = cv2.blur((depth_m > 0).astype(np.float32), (_RANGE_WINDOW_PX, _RANGE_WINDOW_PX))
    return np.where(limit & (share < _RANGE_SHARE), np.float32(0.0), depth_m)


def measured_share(depth_m: np.ndarray) -> float:
    """Which part of the pixels of float32 [H, W] in m, 0 = none, hold a measurement."""
    height, width = require("depth_m", depth_m, (None, None)).shape
    counts = runtime.empty((height * SPLIT,), np.int32)
    kernels.count_measured(depth_m, counts)
    return int(runtime.to_host(counts).sum()) / (height * width)
