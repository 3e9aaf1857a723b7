"""Rows of the map that move with their keyframes."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tgslam.geometry import se3_exp
from tgslam.map.gaussians import CARRIERS, GaussianMap
from tgslam.types import Gaussians


@scenario
def rows(count: int = 300, keyframes: int = 5) -> dict[str, np.ndarray]:
    """Random rows after means of random motions."""
    rng = np.random.default_rng(0)
    moved = GaussianMap()
    moved.append(
        Gaussians(
            mean=rng.normal(size=(count, 3)).astype(np.float32),
            log_scale=np.zeros((count, 3), np.float32),
            quat_wxyz=rng.normal(size=(count, 4)).astype(np.float32),
            opacity_logit=np.zeros(count, np.float32),
            colour=np.zeros((count, 3), np.float32),
            embedding=np.zeros((count, 3), np.float32),
            plane_id=np.full(count, -1, np.int32),
            birth_keyframe=np.zeros(count, np.int32),
        ),
        carriers=rng.integers(0, keyframes, (count, CARRIERS)).astype(np.int32),
    )
    moved.move(np.stack([se3_exp(rng.normal(size=6)) for _ in range(keyframes)]))
    return {"mean": moved.host("mean").copy(), "quat_wxyz": moved.host("quat_wxyz").copy()}
