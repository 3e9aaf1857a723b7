"""Gaussians from the cells of an RGB-D frame: one flat Gaussian each, as the surface lies there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.map_settings import SeedingConfig
from tgslam.geometry import inverse, quat_wxyz_from_matrices, transform_points
from tgslam.mapping.quadtree import Cells
from tgslam.types import Gaussians

_MIN_COSINE = 0.25  # foreshortening is compensated up to here: beyond, a cell's Gaussian would become a needle


def seed(
    cells: Cells,
    normals: NDArray[np.floating],
    camera: Camera,
    T_cw: NDArray[np.float64],
    keyframe: int,
    config: SeedingConfig,
    plane_ids: NDArray[np.int32] | None = None,
) -> Gaussians:
    """One flat Gaussian a cell, in the world frame: aligned with the surface, as wide as the cell's footprint.

    normals: [H, W, 3] in the camera frame towards the camera, 0 = unknown (then the viewing direction is used).
    plane_ids: [H, W] PGI of each pixel, -1 = none. Embeddings are neutral.
    """
    n = len(cells.u)
    row, column = np.rint(cells.v).astype(int), np.rint(cells.u).astype(int)
    ids = np.full(n, -1, np.int32) if plane_ids is None else plane_ids[row, column]
    ray = camera.rays_at(cells.u, cells.v)
    towards = -ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    normal = normals[row, column].astype(np.float64)
    known = (normal * towards).sum(-1) > 0.05
    normal = np.where(known[:, None], normal, towards)
    cosine = np.maximum((normal * towards).sum(-1), _MIN_COSINE)
    # Axes: across the slope (not foreshortened), along the slope, normal
    across = np.cross(normal, towards)
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    helper = np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    across = np.where(
        length > 1e-3, across / np.maximum(length, 1e-12), helper / np.linalg.norm(helper, axis=-1, keepdims=True)
    )
    along = np.cross(normal, across)
    shape = config.expert.gaussians
    footprint = shape.overlap * cells.size_px * cells.depth_m / camera.fx
    scale = np.stack([footprint, footprint / cosine, shape.thickness * footprint], -1)
    T_wc = inverse(T_cw)
    axes = T_wc[:3, :3] @ np.stack([across, along, normal], -1)
    return Gaussians(
        mean=transform_points(T_wc, ray * cells.depth_m[:, None]).astype(np.float32),
        log_scale=np.log(scale).astype(np.float32),
        quat_wxyz=quat_wxyz_from_matrices(axes).astype(np.float32),
        opacity_logit=np.full(n, np.log(shape.seed_opacity / (1.0 - shape.seed_opacity)), np.float32),
        colour=cells.colour.astype(np.float32),
        embedding=np.zeros((n, 3), np.float32),
        plane_id=ids.astype(np.int32),
        birth_keyframe=np.full(n, keyframe, np.int32),
    )
