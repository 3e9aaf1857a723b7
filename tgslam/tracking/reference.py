"""A keyframe as it was measured, which frames are aligned to beside the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.tracking.exposure import Exposure


@dataclass(frozen=True)
class Reference:
    """Splats round narrow edges and creases, which draws the camera; a keyframe's own images are only noisy."""

    colour: NDArray[np.float32]  # [H, W, 3] RGB in [0, 1]
    depth_m: NDArray[np.float32]  # [H, W], 0 = none
    T_cw: NDArray[np.float64]  # [4, 4]
    exposure: Exposure  # of its image
