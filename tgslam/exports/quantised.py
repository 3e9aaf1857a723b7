"""What the compact formats of Gaussians share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.types import Gaussians

Array = NDArray[np.float64]


def as_bytes(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """`values` rounded to the nearest of 0 to 255."""
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def as_units(values: Array, bits: int) -> NDArray[np.uint32]:
    """`values` in [0, 1] as whole numbers of so many bits; what lies outside is clipped."""
    most = 2**bits - 1
    return np.clip(np.round(values * most), 0, most).astype(np.uint32)


def opacity_of(gaussians: Gaussians) -> Array:
    """[N] in (0, 1]."""
    sigmoid = 0.5 + 0.5 * np.tanh(0.5 * gaussians.opacity_logit.astype(np.float64))
    return np.maximum(sigmoid, np.finfo(np.float64).tiny)


def unit_quat(gaussians: Gaussians) -> Array:
    """[N, 4] wxyz of unit length, w >= 0."""
    quat = gaussians.quat_wxyz.astype(np.float64)
    quat = quat / np.linalg.norm(quat, axis=1, keepdims=True)
    return np.where(quat[:, :1] < 0, -quat, quat)
