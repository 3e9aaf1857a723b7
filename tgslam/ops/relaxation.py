"""Relaxation of colours: steps whose length follows from the blend weights."""

from __future__ import annotations

import numpy as np

from tgslam.kernels import relaxation as kernels


def relax(
    count: int,
    visible: np.ndarray,
    grad_colour: np.ndarray,
    curvature: np.ndarray,
    totals: np.ndarray,
    step: float,
    weight: float,
    colour: np.ndarray,
) -> None:
    """Move the colours [N, 3] of the first `count` Gaussians that are visible, int32 [N], downhill; kept in [0, 1].

    grad_colour: [N, 3] and curvature: [N, 2] of the backward pass, totals: of the loss. step: 1 = the full step, less
    than 2. weight: of the loss's intensity term over three times its Charbonnier epsilon: little evidence moves little.
    """
    kernels.relax(count, visible, grad_colour, curvature, totals, step, weight, colour)
