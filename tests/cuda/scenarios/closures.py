"""The sums over points that structure closures are refined with."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tgslam.camera import Camera, SensorNoise
from tgslam.device import runtime
from tgslam.geometry import se3_exp
from tgslam.ops import closure_icp as closure_fit

_NOISE, _MODEL_M = SensorNoise(0.0015), 0.003


@scenario
def sums(points: int = 333, planes: int = 3) -> dict[str, np.ndarray]:
    """Points about a bent surface, labelled as on one of a few planes near it."""
    rng = np.random.default_rng(0)
    camera = Camera(40, 30, 35.0, 34.0, 19.3, 14.6)
    v, u = np.mgrid[: camera.height, : camera.width]
    depth_m = np.float32(2.0 + 0.02 * u - 0.01 * v + 0.05 * np.sin(0.2 * u))
    v, u = rng.integers(0, camera.height, points), rng.integers(0, camera.width, points)
    z = depth_m[v, u] + 0.005 * rng.standard_normal(points)
    at = camera.points_at(u, v, z)
    rows = np.tile([0.0, 0.0, -1.0, 2.2, 1.0, 0.0, 0.0, 0.1, 0.0, -1.0, 0.0, 0.2], (planes, 1))
    rows[:, 3] += 0.1 * np.arange(planes)
    row = rng.integers(-1, planes, points)
    points_on_device = runtime.to_device(at)
    moments = closure_fit.height_moments(points_on_device, runtime.to_device(row, np.int32), rows, _NOISE, _MODEL_M)
    T_ij = se3_exp([0.01, -0.02, 0.005, 0.01, 0.02, -0.01])
    distances = closure_fit.surface_distances(
        points_on_device, T_ij, runtime.to_device(depth_m), camera, _NOISE, _MODEL_M, 0.1
    )
    return {
        "information": moments.information,
        "moment": moments.moment,
        "points": moments.points,
        "A": distances.A,
        "b": distances.b,
        "squares": np.array(distances.squares),
        "matches": np.array(distances.matches),
    }
