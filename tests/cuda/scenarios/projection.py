"""Projection of Gaussians, and its gradient."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tgslam.device import runtime
from tgslam.geometry import se3_exp
from tgslam.kernels import projection, projection_gradient

_WIDTH, _HEIGHT = 50, 37
_CAMERA = (45.0, 48.0, 24.3, 18.9)


def _gaussians(count: int) -> list[np.ndarray]:
    """Mean, log-scale, quaternion, opacity logit, colour, embedding: on all sides of the camera, of many sizes."""
    rng = np.random.default_rng(0)
    mean = rng.normal(size=(count, 3)) * [1.5, 1.5, 2.0] + [0.0, 0.0, 2.0]
    fields = (
        mean,
        np.log(rng.uniform(0.005, 0.3, (count, 3))),
        rng.normal(size=(count, 4)),
        rng.uniform(-6.0, 3.0, count),
        rng.random((count, 3)),
        rng.normal(size=(count, 3)),
    )
    return [runtime.to_device(field) for field in fields]


@scenario
def forward_and_backward(count: int = 300, with_embedding: bool = True) -> dict[str, np.ndarray]:
    """Splats, tiles and the gradients of all parameters and of the pose."""
    mean, log_scale, quat, logit, colour, embedding = _gaussians(count)
    pose = runtime.to_device(se3_exp([0.11, -0.07, 0.2, 0.15, -0.1, 0.3])[:3].reshape(12))
    camera = runtime.to_device(_CAMERA)
    splat, tile_rect = runtime.zeros((count, projection.SPLAT)), runtime.zeros((count, 4), np.int32)
    tile_count = runtime.zeros((count,), np.int32)
    projection.project(
        count, mean, log_scale, quat, logit, colour, embedding, pose, camera, _WIDTH, _HEIGHT, with_embedding,
        splat, tile_rect, tile_count,
    )  # fmt: skip
    rng = np.random.default_rng(1)
    moments = runtime.to_device(rng.normal(size=(count, projection.MOMENTS)))
    blocks = -(-count // projection_gradient.POSE_BLOCK)
    shapes = {
        "mean": (count, 3), "log_scale": (count, 3), "quat": (count, 4), "logit": (count,), "colour": (count, 3),
        "embedding": (count, 3), "curvature": (count, 2), "pose": (blocks, 6),
    }  # fmt: skip
    gradients = {name: runtime.zeros(shape) for name, shape in shapes.items()}
    projection_gradient.project_backward(
        count, mean, log_scale, quat, logit, splat, pose, camera, _WIDTH, _HEIGHT, with_embedding,
        tile_count, moments, *gradients.values(),
    )  # fmt: skip
    results = {"splat": splat, "tile_rect": tile_rect, "tile_count": tile_count}
    results |= {f"grad_{name}": gradient for name, gradient in gradients.items()}
    return {name: runtime.to_host(array) for name, array in results.items()}
