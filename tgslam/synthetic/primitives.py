"""Exact distances to a scene's surfaces."""

from __future__ import annotations

import numpy as np

from tgslam.kernels.raycast import BOX, CYLINDER, QUAD
from tgslam.synthetic.scene import Scene, Vector

_BISECTIONS = 60  # to the last digit of a float64
_LEAST_M = 1e-9  # a coordinate of 0 is taken as this: distances change by no more


def surface_distance_m(scene: Scene, points_w: Vector) -> Vector:
    """[N] from points [N, 3] m, world, to the nearest surface of any primitive; inside solids too it is positive."""
    nearest = np.full(len(points_w), np.inf)
    for i, (shape, *_, layer) in enumerate(scene.meta):
        if layer > 0:
            continue  # painted on another
        offset = points_w - scene.centre_w[i]
        close = np.flatnonzero(np.linalg.norm(offset, axis=1) - scene.radius_m[i] < nearest)
        local = np.abs(offset[close] @ scene.axes_w[i].T)  # all shapes are symmetric
        nearest[close] = np.minimum(nearest[close], _distance_m(shape, local, scene.half_m[i]))
    return nearest


def _distance_m(shape: int, local: Vector, half: Vector) -> Vector:
    """[N] to a primitive's surface from points [N, 3] m in the first octant of its frame."""
    if shape == QUAD:
        return np.linalg.norm(np.maximum(local - half, 0.0), axis=1)
    if shape == BOX:
        return _to_box(local - half)
    if shape == CYLINDER:
        radial = np.hypot(local[:, 0], local[:, 1]) - half[0]
        return _to_box(np.column_stack([radial, local[:, 2] - half[2]]))
    return _to_ellipsoid(local, half)


def _to_box(beyond: Vector) -> Vector:
    """[N] to the surface of a box, for how far [N, K] m a point is beyond each pair of its faces; negative: within."""
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    inside = np.minimum(beyond.max(axis=1), 0.0)
    return np.abs(outside + inside)


def _to_ellipsoid(local: Vector, radii: Vector) -> Vector:
    """[N] to the surface of an ellipsoid, by bisection for the foot of the perpendicular.

    The foot x of the point y has x_i = r_i^2 y_i / (t + r_i^2); t is found from x being on the surface. Counting it
    from the pole, s = t + r_min^2, keeps points close to the shortest axis exact.
    """
    y = np.maximum(local, _LEAST_M)
    shortest = int(np.argmin(radii))
    squared = radii**2
    lead = squared - squared[shortest]
    low, high = radii[shortest] * y[:, shortest], np.linalg.norm(radii * y, axis=1)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        outside = np.sum((radii * y / (middle[:, None] + lead)) ** 2, axis=1) > 1.0
        low, high = np.where(outside, middle, low), np.where(outside, high, middle)
    foot = squared * y / (0.5 * (low + high)[:, None] + lead)
    return np.linalg.norm(foot - y, axis=1)
