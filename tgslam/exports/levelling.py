"""A world that stands upright: z points up, and the origin lies on the floor below the first camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam.exports.moved import moved_planes
from tgslam.geometry import inverse, transform_points
from tgslam.output.floorplan import plan_axes, up_direction
from tgslam.types import Gaussians, Matrix4, Plane

_FLAT_COSINE = np.cos(np.deg2rad(8.0))  # of a floor's normal with up
_FLOOR_SHARE = 0.2  # of the largest level plane's area, at the least, for a plane to be the floor
_LOWEST_PERCENTILE = 1.0  # of the Gaussians' heights, where no plane is the floor


def level_transform(planes: Sequence[Plane], gaussians: Gaussians, T_wc: Matrix4) -> Matrix4:
    """T_lw [4, 4] into the level world l. T_wc: the first camera's pose, whose image tells roughly where up is.

    x is to the right of the first camera and y the way that it looks, both level. The floor is the lowest plane that
    faces up and is not small; without one, nearly all Gaussians lie above the origin.
    """
    T_cw = inverse(T_wc)
    seen = moved_planes(planes, T_cw)
    up = up_direction(seen)
    T_lc = np.eye(4)
    T_lc[:3, :3] = np.concatenate([plan_axes(up), up[None]])
    T_lc[2, 3] = -_floor_height(seen, transform_points(T_cw, gaussians.mean), up)
    return np.asarray(T_lc @ T_cw)


def _floor_height(planes: Sequence[Plane], points: NDArray[np.float64], up: NDArray[np.float64]) -> float:
    """Of the floor along `up`, m."""
    facing_up = [plane for plane in planes if float(plane.normal_w @ up) > _FLAT_COSINE]
    if facing_up:
        least_m2 = _FLOOR_SHARE * max(plane.area_m2 for plane in facing_up)
        return min(float(plane.centroid_w @ up) for plane in facing_up if plane.area_m2 >= least_m2)
    return float(np.percentile(points @ up, _LOWEST_PERCENTILE)) if len(points) else 0.0
