"""The whole system on a short sequence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.cuda.harness import scenario
from tgslam.camera import Camera
from tgslam.config.schema import Config
from tgslam.geometry import inverse, se3_exp
from tgslam.slam import Slam
from tgslam.types import Frame

_CORNER = (np.array([[0.1, 0.05, -1.0], [-1.0, 0.1, 0.0], [0.05, -1.0, -0.1]]), np.array([3.0, 1.2, 0.8]))
_MOTION = [0.004, -0.008, 0.003, 0.01, 0.005, -0.008]


def _frame(camera: Camera, index: int) -> Frame:
    """A textured corner of three planes, without noise, from a camera that moves steadily."""
    T_cw = se3_exp(index * np.array(_MOTION))
    normals_w, offsets_m = _CORNER
    length = np.linalg.norm(normals_w, axis=1)
    normals_c = normals_w / length[:, None] @ T_cw[:3, :3].T
    rays = camera.rays()
    depths = -(offsets_m / length - normals_c @ T_cw[:3, 3]) / (rays @ normals_c.T)
    depth_m = np.where(depths > 0, depths, np.inf).min(axis=-1)
    x, y, z = np.moveaxis(rays * depth_m[..., None] @ inverse(T_cw)[:3, :3].T + inverse(T_cw)[:3, 3], -1, 0)
    colour = 0.5 + 0.2 * np.stack([np.sin(5 * x + z), np.cos(4 * y - x), np.sin(3 * z + 2 * y)], axis=-1)
    return Frame(index, index / 30.0, colour.astype(np.float32), depth_m.astype(np.float32))


@scenario
def run(frames: int = 5, height: int = 60, width: int = 80) -> dict[str, np.ndarray]:
    """Trajectory and map after tracking, mapping at two keyframes or more, and the final refinement."""
    camera = Camera(width, height, 0.8 * width, 0.8 * width, 0.5 * width - 0.5, 0.5 * height - 0.5)
    config = Config()
    mapping = replace(config.mapping, iterations=2, final_iterations=2)
    # Keyframes by time alone: whether 8 % of so small an image are new is a matter of single pixels
    keyframes = replace(config.keyframes, max_interval=3, max_unexplained=1.0)
    system = Slam(camera, replace(config, mapping=mapping, keyframes=keyframes))
    for index in range(frames):
        system.process_frame(_frame(camera, index))
    system.finish()
    gaussians = system.gaussians()
    return {
        "T_wc": system.trajectory().T_wc,
        "keyframes": np.array(system.keyframe_indices()),
        "mean": gaussians.mean,
        "colour": gaussians.colour,
    }
