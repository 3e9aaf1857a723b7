"""Least-squares planes from moments: many small fits at once, and what joining two sets of points costs.

Moments [N, 10] and planes [N, 3] are those of `tgslam.ops.plane_fit`: inverse depth affine in the pixel. They may have
an 11th column, the variance of the points' noise, 1/m^2, summed over the points: it adds up as the moments do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tgslam.ops.plane_fit import Floats, Indices

NOISE = 10  # column of the summed variance

_SINGULAR = 1e-6  # of the product of the variances: points on a line


def squared_residuals(moments: Floats) -> Floats:
    """[N] 1/m^2: sum of squared residuals of the best plane of each set; without a plane, as if it had no slope."""
    return _fitted(moments)[0]


def planes_of(moments: Floats) -> Floats:
    """[N, 3] best planes g0, gx, gy; where the points lie on a line or are too few, a plane without slope."""
    n, x, y, w = moments.T[[0, 1, 2, 6]]
    _, gx, gy = _fitted(moments)
    return np.stack([(w - gx * x - gy * y) / np.maximum(n, 1e-12), gx, gy], axis=1)


def information(moments: Floats) -> Floats:
    """[N, 3, 3] normal matrices over (g0, gx, gy)."""
    return moments[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def noise_of(moments: Floats) -> Floats:
    """[N] 1/m: standard deviation of the points' noise."""
    return np.sqrt(moments[:, NOISE] / np.maximum(moments[:, 0], 1.0))


def width_px(moments: Floats) -> Floats:
    """[N] of rectangles that scatter like the points, the shorter side, in px."""
    xx, xy, _, yy = scatter(moments).reshape(-1, 4).T
    least = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), xy)
    return np.sqrt(12.0 * np.maximum(least, 0.0))


def scatter(moments: Floats) -> Floats:
    """[N, 2, 2] px^2, covariances of the points' places in the image."""
    n, x, y, xx, xy, yy = moments.T[:6]
    mean_x, mean_y = x / n, y / n
    across = xy - mean_x * y
    return (np.stack([xx - mean_x * x, across, across, yy - mean_y * y], axis=1) / n[:, None]).reshape(-1, 2, 2)


def summed(rows: Floats, group: Indices, groups: int) -> Floats:
    """[groups, K] sums of the rows [N, K] that belong to each group [N], added in their order."""
    return np.stack([np.bincount(group, column, groups) for column in rows.T], axis=1)


@dataclass(frozen=True)
class Joints:
    """Pairs of sets of points, each held against one plane for both of its sets."""

    moments: Floats  # [E, 11] of both together
    fewer: Floats  # [E] points of the smaller set
    cost: Floats  # [E] 1/m^2, by how much the squared residuals grow if one plane serves both

    @classmethod
    def of(cls, moments: Floats, first: Indices, second: Indices) -> Joints:
        """Of the sets `first` and `second` [E] out of those with these moments [N, 11].

        The cost is d^T (P_1 + P_2)^-1 d, d the difference of the two planes and P their covariances at unit noise.
        """
        squares, size = squared_residuals(moments), moments[:, 0]
        both = moments.take(first, axis=0)
        both += moments.take(second, axis=0)
        cost = np.maximum(squared_residuals(both) - squares[first] - squares[second], 0.0)
        return cls(both, np.minimum(size[first], size[second]), cost)


def _fitted(moments: Floats) -> tuple[Floats, Floats, Floats]:
    """Squared residuals and slopes gx, gy; each [N]."""
    n, x, y, xx, xy, yy, w, xw, yw, ww = np.ascontiguousarray(moments.T[:NOISE])
    inverse = 1.0 / np.maximum(n, 1e-12)
    mx, my, mw = x * inverse, y * inverse, w * inverse
    xx, xy, yy = xx - mx * x, xy - mx * y, yy - my * y
    xw, yw, ww = xw - mx * w, yw - my * w, ww - mw * w
    det = xx * yy - xy * xy
    scale = np.where(det > _SINGULAR * xx * yy, 1.0, 0.0) / np.where(det > 0, det, 1.0)
    gx, gy = (yy * xw - xy * yw) * scale, (xx * yw - xy * xw) * scale
    return np.maximum(ww - gx * xw - gy * yw, 0.0), gx, gy
