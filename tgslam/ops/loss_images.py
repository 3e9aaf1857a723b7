"""What the objective's passes take and give."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PreparedObservation:
    """A keyframe's side as device arrays, in the layout that the device's passes read."""

    colour: np.ndarray  # RGB
    depth: np.ndarray  # m, 0 = none
    mask: np.ndarray  # M_rgb in [0, 1]
    gate: np.ndarray  # T of Eq. 11
    luma: np.ndarray
    texture: np.ndarray  # 1 - T, 0 in the border of 5 px
    statistics: np.ndarray  # mean and variance of luma in the SSIM window


@dataclass(frozen=True)
class LossImages:
    """Derivatives of the objective as device arrays, overwritten by the next evaluation in the same scratch memory."""

    colour: np.ndarray  # [H, W, 3] by rendered colour
    depth: np.ndarray  # [H, W] by accumulated depth, 1/m
    opacity: np.ndarray  # [H, W] by accumulated opacity
    w_colour: np.ndarray  # [H, W] curvature of the intensity term by a rendered channel (reweighted least squares)
    w_depth: np.ndarray  # [H, W] curvature of E_geo by accumulated depth, 1/m^2
    totals: np.ndarray  # [TOTALS] sums over the image, see kernels/objective.py
