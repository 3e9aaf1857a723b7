"""Pixels as sensors store them, made float: written once, so that all ways in give the same bits. NumPy only."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.types import FloatImage


def colour_as_float(rgb: NDArray[np.uint8]) -> FloatImage:
    """8-bit colour [H, W, 3] -> float32 in [0, 1]."""
    return np.multiply(rgb, np.float32(1.0 / 255.0), dtype=np.float32)


def depth_as_metres(raw: NDArray[Any], units_per_metre: float) -> FloatImage:
    """Raw depth [H, W] -> float32 m, a new array."""
    depth_m = raw.astype(np.float32)
    depth_m *= np.float32(1.0 / units_per_metre)
    return depth_m
