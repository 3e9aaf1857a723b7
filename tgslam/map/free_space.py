"""What has come in front of what other keyframes saw there: it moves, or somebody holds it before the lens."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import SensorNoise
from tgslam.geometry import inverse, transform_points
from tgslam.map.world import Map
from tgslam.recognition.depth_agreement import DepthGrid
from tgslam.types import Matrix4

_OTHERS = 8  # keyframes on either side in time; what stands still for as many as before is not new any more
_MARGIN = 0.1  # of the depth: nearer to what was seen than that, poses and noise may be the reason
_SIGMAS = 6.0
_AROUND = np.ones((3, 3), np.uint8)


def intruding(world: Map, number: int) -> NDArray[np.bool_]:
    """[H, W] pixels of a keyframe whose surfaces are where more of its neighbours see through than see a surface.

    Of single pixels and seams, which noise and edges make, there are none.
    """
    look, T_wc = world.looks[number], inverse(world.keyframes[number].T_cw)
    through, on = (np.zeros(look.depth.depth_m.shape, np.int32) for _ in range(2))
    last = min(number + _OTHERS, len(world.keyframes) - 1)
    for other in range(max(number - _OTHERS, 0), last + 1):
        if other != number:
            T = world.keyframes[other].T_cw @ T_wc
            ahead, same = _compared(look.depth, T, world.looks[other].depth, world.noise)
            through += ahead
            on += same
    found = ((through >= 2) & (through > on)).astype(np.uint8)
    found = cv2.dilate(cv2.erode(found, _AROUND, borderValue=1), _AROUND, iterations=2)
    if not found.any():
        return np.zeros(world.camera.shape, bool)
    size = world.camera.width, world.camera.height
    return cv2.resize(found, size, interpolation=cv2.INTER_NEAREST).astype(bool)


def _compared(
    seen: DepthGrid, T: Matrix4, other: DepthGrid, noise: SensorNoise
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """[h, w] each: where another view, whose camera T [4, 4] takes points to, sees through a surface, and sees it."""
    v, u = np.nonzero(seen.depth_m > 0)
    moved = transform_points(T, seen.points())
    z = moved[:, 2]
    column, row = (np.rint(places) for places in other.camera.project(moved))
    inside = (z > 0) & other.camera.holds(column, row)
    v, u, z = v[inside], u[inside], z[inside]
    column, row = column[inside].astype(np.int64), row[inside].astype(np.int64)
    # The nearest and the farthest around decide, so that an edge off by one speaks neither for nor against
    near = cv2.erode(np.where(other.depth_m > 0, other.depth_m, np.inf), _AROUND, borderValue=np.inf)[row, column]
    far = cv2.dilate(other.depth_m, _AROUND)[row, column]
    margin_m = _MARGIN * z + _SIGMAS * noise.per_m2 * far.astype(np.float64) ** 2
    known = np.isfinite(near)
    through, on = (np.zeros(seen.depth_m.shape, bool) for _ in range(2))
    through[v, u] = known & (z < near - margin_m)
    on[v, u] = known & (z >= near - margin_m) & (z <= far + margin_m)
    return through, on
