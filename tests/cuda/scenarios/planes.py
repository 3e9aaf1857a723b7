"""Planes of a single view."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tgslam.camera import Camera, SensorNoise
from tgslam.config.plane_settings import PlanesConfig
from tgslam.device import runtime
from tgslam.planes.segmentation.extraction import extract_planes

_SIGMA_PER_M2 = 0.0015


@scenario
def extraction(height: int = 61, width: int = 90) -> dict[str, np.ndarray]:
    """Two walls that meet over a floor, a post in front of them, noise and holes."""
    rng = np.random.default_rng(0)
    camera = Camera(width, height, 80.0, 78.0, 44.3, 30.2)
    v, u = np.mgrid[:height, :width]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    inverse = np.max([0.45 + 0.3 * x, 0.45 - 0.3 * x, 0.25 + 0.9 * y], axis=0)
    inverse[:40, 60:66] = 0.9
    depth_m = 1.0 / (inverse + _SIGMA_PER_M2 * rng.normal(size=inverse.shape))
    depth_m[rng.random(depth_m.shape) < 0.05] = 0.0
    view = extract_planes(runtime.to_device(depth_m), camera, PlanesConfig(), SensorNoise(_SIGMA_PER_M2))
    segments = view.segments
    return {
        "labels": view.labels,
        "normal": np.array([s.normal_c for s in segments]),
        "offset_m": np.array([s.offset_m for s in segments]),
        "covariance": np.array([s.covariance for s in segments]),
        "reliable": np.array([s.reliable for s in segments]),
    }
