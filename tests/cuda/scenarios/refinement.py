"""Iterations of mapping: render, compare, differentiate, move the map and a keyframe's pose."""

from __future__ import annotations

import numpy as np

from tests.cuda.harness import scenario
from tests.tiers import changed
from tgslam.camera import Camera
from tgslam.config.input_settings import SyntheticConfig
from tgslam.config.map_settings import LossConfig, MappingConfig
from tgslam.config.plane_settings import StructureConfig
from tgslam.datasets.built_in import SyntheticSource
from tgslam.geometry import se3_exp
from tgslam.map.gaussians import PARAMETERS, GaussianMap
from tgslam.map.keyframes import Keyframe
from tgslam.mapping.refinement import Refiner
from tgslam.mapping.structure_terms import StructureTerms
from tgslam.ops.vector_adam import VectorAdam
from tgslam.planes.instances.plane_table import PlaneTable
from tgslam.types import Exposure, Frame, Gaussians

_GRID = (40, 30)  # Gaussians in a row, rows


def _facing(frame: Frame, camera: Camera) -> Gaussians:
    """Gaussians on the surface that a frame sees, a little too dark and too far, and some more behind the camera.

    Where a gradient is about 0, rounding decides which way Adam's first steps go.
    """
    columns, rows = np.linspace(1, camera.width - 2, _GRID[0]), np.linspace(1, camera.height - 2, _GRID[1])
    u, v = (pixel.ravel() for pixel in np.meshgrid(columns, rows))
    at = v.astype(int), u.astype(int)
    z = 1.005 * np.where(frame.depth_m[at] > 0, frame.depth_m[at], 2.0)
    mean = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], 1) * z[:, None]
    mean[::9] *= -1.0
    n, size = len(z), z * camera.width / _GRID[0] / camera.fx
    rng = np.random.default_rng(0)
    return Gaussians(
        mean=mean.astype(np.float32),
        log_scale=np.log(size[:, None] * [0.6, 0.6, 0.1]).astype(np.float32),
        quat_wxyz=(np.float32([1, 0, 0, 0]) + 0.1 * rng.normal(size=(n, 4))).astype(np.float32),
        opacity_logit=np.full(n, 2.0, np.float32),
        colour=0.8 * frame.colour[at],
        embedding=np.zeros((n, 3), np.float32),
        plane_id=np.full(n, -1, np.int32),
        birth_keyframe=np.zeros(n, np.int32),
    )


def _see_planes(source: SyntheticSource, keyframe: Keyframe, gaussians: GaussianMap, terms: StructureTerms) -> None:
    """The true planes of the first view, in the camera's frame, which is about the map's."""
    T_wc, planes_w, camera = source.pose(0), source.planes(), source.camera
    offsets = planes_w[:, 3] + planes_w[:, :3] @ T_wc[:3, 3]
    local = np.column_stack([planes_w[:, :3] @ T_wc[:3, :3], offsets])
    terms.know(PlaneTable(local, np.arange(len(local), dtype=np.int32)), 1)
    labels = source.labels(0)
    keyframe.show(labels)
    mean = gaussians.host("mean")
    u = np.rint(camera.fx * mean[:, 0] / mean[:, 2] + camera.cx).astype(int)
    v = np.rint(camera.fy * mean[:, 1] / mean[:, 2] + camera.cy).astype(int)
    gaussians.write("plane_id", slice(0, gaussians.count), labels[v, u])


@scenario
def steps(optimizer: str = "relaxation", steps: int = 3, planes: bool = False) -> dict[str, np.ndarray]:
    """The map, the pose, the losses and the record of the views after some steps on one keyframe.

    planes: the keyframe and the Gaussians know theirs; the embeddings then move as well.
    """
    source = SyntheticSource(SyntheticConfig(scene="room", width=64, height=48, frames=720), seed=0)
    frame = source.read(0)
    gaussians = GaussianMap.from_gaussians(_facing(frame, source.camera))
    structure = changed(StructureConfig(), pgi_interval=2) if planes else None
    refiner = Refiner(gaussians, source.camera, MappingConfig(optimizer=optimizer), LossConfig(), structure)
    pose = se3_exp([0.002, -0.001, 0.001, 0.003, 0.002, -0.004])
    keyframe, adam = Keyframe(frame, pose, Exposure(1.1, 0.02), np.eye(6)), VectorAdam([0.0003] * 6)
    if refiner.structure:
        _see_planes(source, keyframe, gaussians, refiner.structure)
    values = []
    for _ in range(steps):
        found = refiner.step(keyframe, pose)
        values.append(found.loss.value)
        pose = se3_exp(adam.step(found.g_pose)) @ pose
    return {name: gaussians.host(name).copy() for name in PARAMETERS} | {
        "pose": pose,
        "values": np.array(values),
        "contribution": gaussians.host("contribution").copy(),
        "views": gaussians.host("views").copy(),
    }
