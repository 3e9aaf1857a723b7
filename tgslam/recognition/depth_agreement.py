"""Do the depth images of two views fit together under a motion?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.geometry import inverse, transform_points
from tgslam.ops.image import DEPTH_EDGE
from tgslam.types import FloatImage

_ACROSS = 80  # pixels at most that are kept of a row: what is compared are shares, not outlines
_SIGMAS = 4.0  # of two measurements by which one surface may differ, beyond what a slanted pixel does


@dataclass(frozen=True)
class DepthGrid:
    """Every so manieth pixel of a depth image, and its camera."""

    depth_m: FloatImage  # [h, w], 0 = none
    camera: Camera

    @classmethod
    def of(cls, depth_m: FloatImage, camera: Camera) -> DepthGrid:
        """From [H, W] m, 0 = none."""
        step = -(-camera.width // _ACROSS)
        first = step // 2
        return cls(depth_m[first::step, first::step].astype(np.float32), camera.strided(step))

    def points(self) -> NDArray[np.float64]:
        """[N, 3] m, camera frame, of the pixels with a measurement."""
        v, u = np.nonzero(self.depth_m > 0)
        return self.camera.points_at(u, v, self.depth_m[v, u])


def agreement(in_i: DepthGrid, in_j: DepthGrid, T_ji: NDArray[np.float64], noise: SensorNoise) -> tuple[float, float]:
    """Which part of the points that either view should see of the other's lie on its surface; and the least part of
    an image's pixels for which that is so. Points behind a surface are hidden, and speak neither for nor against.
    """
    ahead = compared(in_i.points(), T_ji, in_j, noise)
    back = compared(in_j.points(), inverse(T_ji), in_i, noise)
    on, before = ahead[0] + back[0], ahead[1] + back[1]
    return on / max(on + before, 1), min(ahead[0] / in_i.depth_m.size, back[0] / in_j.depth_m.size)


def compared(
    points: NDArray[np.float64], T: NDArray[np.float64], other: DepthGrid, noise: SensorNoise
) -> tuple[int, int]:
    """How many points [N, 3] m, which T [4, 4] takes to the other view's frame, lie on its surface, and how many in
    front of it.
    """
    moved = transform_points(T, points)
    moved = moved[moved[:, 2] > 0.0]
    z = moved[:, 2]
    u, v = (np.rint(places) for places in other.camera.project(moved))
    inside = other.camera.holds(u, v)
    z, measured = z[inside], other.depth_m[v[inside].astype(np.int64), u[inside].astype(np.int64)].astype(np.float64)
    tolerance = DEPTH_EDGE * measured + _SIGMAS * np.sqrt(2.0) * noise.per_m2 * measured**2
    error = (z - measured)[measured > 0]
    tolerance = tolerance[measured > 0]
    return int(np.sum(np.abs(error) <= tolerance)), int(np.sum(error < -tolerance))
