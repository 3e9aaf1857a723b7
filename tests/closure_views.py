"""Depth images of a box room with things in it that are on no plane, and the planes as each view fits them."""

from __future__ import annotations

import numpy as np

from tests.plane_worlds import Box, looking, shifted
from tgslam.camera import Camera, SensorNoise
from tgslam.geometry import inverse, tangent_axes
from tgslam.graph.structure.icp import View
from tgslam.planes.estimate import PlaneEstimate

CAMERA = Camera(160, 120, 130.0, 128.0, 79.1, 60.3)
SIGMA_PER_M2 = 0.0015
NOISE = SensorNoise(SIGMA_PER_M2)
ROOM = Box((4.0, 2.5, 5.0))
BALLS = (((1.3, 1.9, 4.0), 0.5), ((2.6, 2.1, 3.7), 0.35), ((2.0, 1.4, 4.4), 0.4))
WALK = (looking(np.array([1.9, 1.3, 1.4]), 0.25, 0.2), looking(np.array([2.2, 1.25, 1.9]), -0.1, 0.3))  # T_cw


def view(T_cw: np.ndarray, rng: np.random.Generator, balls: bool = True, noise: float = 1.0) -> View:
    """What a camera sees: depth with the sensor's noise and some holes, and which wall (or none) each pixel is on."""
    rays = CAMERA.rays()
    nearest, ids = np.full(CAMERA.shape, np.inf), np.full(CAMERA.shape, -1)
    for index in range(6):
        normal, offset = ROOM.plane(index)
        normal_c = T_cw[:3, :3] @ normal
        along = rays @ normal_c
        with np.errstate(divide="ignore"):
            z = -(offset - normal_c @ T_cw[:3, 3]) / along
        closer = (along < 0) & (z > 0) & (z < nearest)
        nearest[closer], ids[closer] = z[closer], index
    for centre, radius in BALLS if balls else ():
        c = T_cw[:3, :3] @ centre + T_cw[:3, 3]
        a, b, d = np.sum(rays**2, -1), rays @ c, c @ c - radius**2
        root = np.sqrt(np.maximum(b * b - a * d, 0.0))
        z = (b - root) / a
        closer = (b * b > a * d) & (z > 0) & (z < nearest)
        nearest[closer], ids[closer] = z[closer], -1
    depth = nearest + noise * SIGMA_PER_M2 * nearest**2 * rng.standard_normal(CAMERA.shape)
    depth[rng.random(CAMERA.shape) < 0.02] = 0.0
    return View(depth.astype(np.float32), ids)


def fits(seen: View, T_cw: np.ndarray, rng: np.random.Generator, noise: float = 1.0) -> dict[int, PlaneEstimate]:
    """The walls in view, each with an error drawn from the covariance that it is given: 4 mrad and 4 mm."""
    found = {}
    for index in range(6):
        pixels = (seen.plane_ids == index) & (seen.depth_m > 0)
        if pixels.sum() < 300:
            continue
        v, u = np.nonzero(pixels)
        z = seen.depth_m[v, u]
        centroid = np.mean([(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z], axis=1)
        normal, offset = ROOM.plane(index)
        normal_c = T_cw[:3, :3] @ normal
        offset_c = offset - normal_c @ T_cw[:3, 3]
        centroid = centroid - (normal_c @ centroid + offset_c) * normal_c
        sigma = np.full(3, 0.004)
        plane = PlaneEstimate(normal_c, np.asarray(offset_c), centroid, tangent_axes(normal_c), np.diag(sigma**2))
        found[index] = shifted(plane, noise * sigma * rng.standard_normal(3))
    return found


def motion() -> np.ndarray:
    """The true T_ji of `WALK`."""
    return WALK[1] @ inverse(WALK[0])
