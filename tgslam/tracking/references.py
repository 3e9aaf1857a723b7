"""A keyframe as it was measured, which frames are aligned to beside the map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tgslam.geometry import inverse
from tgslam.types import Exposure

NO_PLANES: NDArray[np.float64] = np.zeros((0, 4))

# Between two views that show the same alike at most, relative to the median depth
_BASELINE = 0.8  # to any side
_BASELINE_AHEAD = 0.2  # along the axis: noise grows with the square of depth, by so much to 1.4 times
_LEAST_COSINE = 0.87  # of the angle between their axes: 30 degrees, half of a usual field of view


@dataclass(frozen=True)
class Reference:
    """Splats round narrow edges and creases, which draws the camera; a keyframe's own images are only noisy."""

    colour: NDArray[np.float32]  # [H, W, 3] RGB in [0, 1]
    depth_m: NDArray[np.float32]  # [H, W], 0 = none
    T_cw: NDArray[np.float64]  # [4, 4]
    exposure: Exposure  # of its image
    planes_c: NDArray[np.float64] = field(default_factory=lambda: NO_PLANES)  # [P, 4] whose normals its surfaces take


def references_of(T_cw: NDArray[np.float64], median_depth_m: float, count: int) -> list[int]:
    """The last keyframe and the oldest ones that show alike what it shows: `count` at most of the poses T_cw [K, 4, 4].

    The oldest have drifted least.
    """
    T_wc = inverse(T_cw)
    from_last_m = T_wc[:, :3, 3] - T_wc[-1, :3, 3]
    alike = np.linalg.norm(from_last_m, axis=1) <= _BASELINE * median_depth_m
    alike &= np.abs(from_last_m @ T_wc[-1, :3, 2]) <= _BASELINE_AHEAD * median_depth_m
    alike &= T_wc[:, :3, 2] @ T_wc[-1, :3, 2] >= _LEAST_COSINE
    last = len(T_cw) - 1
    return [last, *np.flatnonzero(alike[:last]).tolist()][:count]
