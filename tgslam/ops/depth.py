"""What a sensor's depth image has too much of: flying pixels are dropped."""

from __future__ import annotations

import numpy as np

from tgslam.camera import SensorNoise
from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import depth as kernels
from tgslam.kernels.image import SPLIT

STEEPEST = 5.7  # tangent of 80 degrees: surfaces that are more grazing return no light to a sensor
_TOLERANCE_SIGMAS = 4.2  # three sigma of a difference of two measurements
_MIN_NEIGHBOURS = 4  # of eight


def without_flying_pixels(depth_m: np.ndarray, noise: SensorNoise, focal_px: float) -> np.ndarray:
    """Drop measurements that fewer than half of their neighbours support: sensors interpolate across edges.

    depth_m: float32 [H, W], 0 = none. Returns a new [H, W] array.
    """
    require("depth_m", depth_m, (None, None))
    kept = runtime.empty(depth_m.shape)
    kernels.keep_supported(depth_m, noise.per_m2, _TOLERANCE_SIGMAS, STEEPEST / focal_px, _MIN_NEIGHBOURS, kept)
    return kept


def measured_share(depth_m: np.ndarray) -> float:
    """Which part of the pixels of float32 [H, W] in m, 0 = none, hold a measurement."""
    height, width = require("depth_m", depth_m, (None, None)).shape
    counts = runtime.empty((height * SPLIT,), np.int32)
    kernels.count_measured(depth_m, counts)
    return int(runtime.to_host(counts).sum()) / (height * width)
