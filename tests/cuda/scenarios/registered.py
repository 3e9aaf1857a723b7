"""Depth of a camera of its own in the pixels of the colour camera."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tgslam.camera import Camera
from tgslam.geometry import se3_exp
from tgslam.ops.registration import Registration


@scenario
def depth() -> dict[str, np.ndarray]:
    """A slanted wall with a box before it and holes."""
    camera, colour = Camera(48, 36, 40.0, 41.0, 23.0, 18.0), Camera(60, 40, 55.0, 54.0, 30.0, 19.0)
    v, u = np.mgrid[:36, :48]
    depth_m = (2.0 + 0.02 * u + 0.01 * v).astype(np.float32)
    depth_m[8:20, 10:25] = 1.2
    depth_m[np.random.default_rng(0).random(depth_m.shape) < 0.1] = 0.0
    motion = se3_exp([0.02, -0.03, 0.01, 0.06, 0.02, -0.01])
    return {"depth_m": Registration(camera.rays()[..., :2], motion, colour)(depth_m)}
