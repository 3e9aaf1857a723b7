"""What the objective's passes give on any device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LossImages:
    """Derivatives of the objective as device arrays, overwritten by the next evaluation in the same scratch memory."""

    colour: np.ndarray  # [H, W, 3] by rendered colour
    depth: np.ndarray  # [H, W] by accumulated depth, 1/m
    opacity: np.ndarray  # [H, W] by accumulated opacity
    w_colour: np.ndarray  # [H, W] curvature of the intensity term by a rendered channel (reweighted least squares)
    w_depth: np.ndarray  # [H, W] curvature of E_geo by accumulated depth, 1/m^2
    totals: np.ndarray  # [TOTALS] sums over the image, see kernels/objective.py
