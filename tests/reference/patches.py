"""The patches of a frame from their definition, cube by cube."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from tgslam.camera import Camera


def patches_of(
    depth_m: np.ndarray, ids: np.ndarray, camera: Camera, T_wc: np.ndarray
) -> dict[tuple[int, ...], tuple[int, int, float]]:
    """(cube's x, y, z, face) -> id, pixels, area in m2 of the patches of `tgslam.evaluation.patches.patches_of`."""
    rays, cubes = camera.rays(), defaultdict(list)
    for v, u in zip(*np.nonzero(depth_m), strict=True):
        point = T_wc[:3, :3] @ rays[v, u] * float(depth_m[v, u]) + T_wc[:3, 3]
        cubes[tuple(np.floor(point / 0.1).astype(int))].append((v, u, point))
    found = {}
    for cube, members in cubes.items():
        shown = [ids[v, u] for v, u, _ in members]
        best = max(set(shown), key=shown.count)
        if len(members) < 4 or best < 0 or shown.count(best) < 0.8 * len(members):
            continue
        points = np.array([point for *_, point in members])
        variances, axes = np.linalg.eigh(np.cov(points.T, bias=True))
        if variances[1] < max(1.5 * variances[0], 0.005**2):
            continue
        towards = np.sign((T_wc[:3, 3] - points.mean(axis=0)) @ axes[:, 0])
        normal = towards * axes[:, 0]
        facing = np.mean([abs(normal @ T_wc[:3, :3] @ rays[v, u]) for v, u, _ in members])
        if facing < 0.15:
            continue
        axis = int(np.argmax(np.abs(normal)))
        area = sum(float(depth_m[v, u]) ** 2 for v, u, _ in members) / (camera.fx * camera.fy) / facing
        found[(*cube, 2 * axis + (normal[axis] > 0))] = (int(best), len(members), area)
    return found
