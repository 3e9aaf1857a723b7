"""Operations on points that two keyframes share: planes fitted anew, and distances from the other one's surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import closure_icp as kernels

Floats = NDArray[np.float64]

_UPPER = np.triu_indices(kernels.UNKNOWNS)


@dataclass(frozen=True)
class HeightMoments:
    """Weighted sums over the points [P] of planes, of the features f = (v, -u, 1) and the height h over the plane.

    u and v are m along the tangents from the centroid; f is the height per turn about each tangent and per shift.
    """

    information: Floats  # [P, 3, 3] sum of w f f^T
    moment: Floats  # [P, 3] sum of w f h
    points: Floats  # [P]


@dataclass(frozen=True)
class SurfaceDistances:
    """Normal equations of distances, in a left perturbation (rotation rad, translation m) of T_ji."""

    A: Floats  # [6, 6]
    b: Floats  # [6]
    squares: float  # robustly weighted, in sigmas
    matches: int


def height_moments(
    points: np.ndarray, row: np.ndarray, planes: Floats, noise: SensorNoise, surface_sigma_m: float
) -> HeightMoments:
    """Of points over the planes that they are on, with Cauchy weights of the sensor's noise.

    points: device [N, 3] m, N > 0. row: device int32 [N], index into `planes`, -1 = none. planes: [P, 12] in the
    frame of the points: normal, d, and each tangent followed by its product with the centroid. surface_sigma_m: error
    of surfaces beyond the sensor's noise.
    """
    require("points", points, (None, 3))
    require("row", row, (points.shape[0],), np.int32)
    partial = runtime.empty((_blocks(points), len(planes), kernels.HEIGHT_SUMS))
    kernels.plane_heights(points, row, runtime.to_device(planes), noise.per_m2, surface_sigma_m, partial)
    sums = runtime.to_host(partial).sum(axis=0, dtype=np.float64)
    w, u, v, uu, uv, vv, h, uh, vh, count = sums.T
    rows = [[vv, -uv, v], [-uv, uu, -u], [v, -u, w]]
    return HeightMoments(np.moveaxis(np.array(rows), -1, 0), np.stack([vh, -uh, h], axis=1), count)


def surface_distances(
    points: np.ndarray,
    T_ij: Floats,
    depth_m: np.ndarray,
    camera: Camera,
    noise: SensorNoise,
    surface_sigma_m: float,
    limit_m: float,
) -> SurfaceDistances:
    """Of points of camera j from the surface that camera i's depth image shows.

    points: device [N, 3] m, N > 0. depth_m: device [H, W] m, 0 = none. A point matches the surface at the pixel that
    it falls on, if that is no farther than `limit_m`. surface_sigma_m: as in `height_moments`.
    """
    require("points", points, (None, 3))
    require("depth_m", depth_m, camera.shape)
    partial = runtime.empty((_blocks(points), kernels.MATCH_SUMS))
    kernels.surface_distances(
        points, runtime.to_device(T_ij[:3]), depth_m, runtime.to_device(camera.intrinsics), noise.per_m2,
        surface_sigma_m, limit_m, partial,
    )  # fmt: skip
    sums = runtime.to_host(partial).sum(axis=0, dtype=np.float64)
    A = np.zeros((kernels.UNKNOWNS, kernels.UNKNOWNS))
    A[_UPPER] = A.T[_UPPER] = sums[: kernels.TRIANGLE]
    b = sums[kernels.TRIANGLE : kernels.SQUARES]
    return SurfaceDistances(A, b, float(sums[kernels.SQUARES]), round(sums[kernels.MATCHES]))


def _blocks(points: np.ndarray) -> int:
    return -(-points.shape[0] // kernels.BLOCK)
