"""Bookkeeping over the map's rows."""

from __future__ import annotations

import numpy as np

from tgslam.kernels import rows as kernels


def record_view(
    rows: int,
    visible: np.ndarray,
    curvature: np.ndarray,
    totals: np.ndarray,
    weight: float,
    contribution: np.ndarray,
    views: np.ndarray,
) -> None:
    """Count a view of the first `rows` Gaussians, and what each of them contributed to its pixels.

    visible: int32 [N], 0 = not in the view. curvature: [N, 2] of the backward pass, totals: of the loss. weight: of the
    loss's intensity term over three times its Charbonnier epsilon. contribution: [N] px, the most blend weight that any
    view gave a row, and views: int32 [N], how many had it in sight; both are changed.
    """
    kernels.record_view(rows, visible, curvature, totals, weight, contribution, views)
