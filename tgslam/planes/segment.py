"""What one view says of planes: n . x + d = 0 with |n| = 1, n towards the camera, so d > 0 in the camera frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class PlaneSegment:
    """A plane as one depth image shows it, in that camera's frame."""

    normal_c: Vector  # [3] unit, towards the camera
    offset_m: float  # d of n . x + d = 0
    centroid_c: Vector  # [3] m, of its pixels' points, weighted like the fit
    covariance: Vector  # [3, 3] of (rad about tangent 1, rad about tangent 2, m along the normal at the centroid)
    area_px: int
    area_m2: float  # of the visible surface
    rms_sigmas: float  # root mean square residual in standard deviations of the sensor: about 1 for a plane
    rms_m: float
    reliable: bool  # False: ambiguous, other views have to confirm it before it counts


@dataclass(frozen=True)
class PlaneView:
    """The planes of one depth image."""

    labels: NDArray[np.int32]  # [H, W] index into segments, -1 = on no plane
    segments: tuple[PlaneSegment, ...]  # largest first
    steps: frozenset[tuple[int, int]] = frozenset()  # adjoining segments that are level but for a step between them
