"""Triangles of flat polygons, by clipping ears."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Triangles = NDArray[np.int64]


def triangulate(polygon: Points) -> Triangles:
    """Corners [K - 2, 3] of triangles that fill a polygon [K, 2] without holes, K >= 3, in the polygon's own sense.

    The signed areas always add up to the polygon's, even where its outline meets itself.
    """
    sense = 1.0 if signed_area(polygon) >= 0 else -1.0
    left = list(range(len(polygon)))
    triangles = []
    while len(left) > 3:
        ear = _ear(polygon[left], sense)
        triangles.append((left[ear - 1], left[ear], left[(ear + 1) % len(left)]))
        del left[ear]
    return np.array([*triangles, left], np.int64)


def signed_area(polygon: Points) -> float:
    """Of a polygon [K, 2]; positive when its corners go counter-clockwise."""
    following = np.roll(polygon, -1, axis=0)
    return float(0.5 * np.sum(polygon[:, 0] * following[:, 1] - polygon[:, 1] * following[:, 0]))


def _ear(polygon: Points, sense: float) -> int:
    """The corner to cut off: a convex one whose triangle holds no other corner; else the most convex one."""
    before, after = np.roll(polygon, 1, axis=0), np.roll(polygon, -1, axis=0)
    convexity = sense * _cross(polygon - before, after - polygon)
    for corner in np.flatnonzero(convexity > 0):
        triangle = np.stack([before[corner], polygon[corner], after[corner]])
        if not _holds_any(triangle, polygon, sense):
            return int(corner)
    return int(np.argmax(convexity))


def _holds_any(triangle: Points, points: Points, sense: float) -> bool:
    """Whether any point [K, 2] lies in a triangle [3, 2] or on its edges; its own corners do not count."""
    sides = [sense * _cross(triangle[(i + 1) % 3] - triangle[i], points - triangle[i]) >= 0 for i in range(3)]
    own = (points[:, None] == triangle).all(axis=2).any(axis=1)
    return bool((sides[0] & sides[1] & sides[2] & ~own).any())


def _cross(a: Points, b: Points) -> Points:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
