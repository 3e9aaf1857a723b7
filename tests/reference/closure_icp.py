"""Sums of `kernels.closure_icp` in float64 NumPy, point by point."""

import numpy as np

REACH, STEEP, MIN_COSINE = 2, 0.1, 0.2


def plane_heights(points, row, planes, depth_sigma, model_sigma):
    """[P, 10]"""
    sums = np.zeros((len(planes), 10))
    for p, k in zip(points, row, strict=True):
        if k < 0:
            continue
        normal, d, first, u0, second, v0 = np.split(planes[k], [3, 4, 7, 8, 11])
        h = normal @ p + d[0]
        u, v = first @ p - u0[0], second @ p - v0[0]
        variance = (depth_sigma * p[2] * (normal @ p)) ** 2 + model_sigma**2
        e2 = h * h / variance
        w = 1.0 / (1.0 + 0.25 * e2) / variance
        features = np.array([1.0, u, v, u * u, u * v, v * v, h, u * h, v * h])
        sums[k, :9] += w * features
        sums[k, 9] += 1.0
    return sums


def surface(depth, u, v, camera):
    fx, fy, cx, cy = camera
    return depth[v, u] * np.array([(u - cx) / fx, (v - cy) / fy, 1.0])


def normal_at(depth, u, v, camera):
    """None where the surface has none."""
    around = [surface(depth, u + a, v + b, camera) for a, b in ((-REACH, 0), (REACH, 0), (0, -REACH), (0, REACH))]
    centre = surface(depth, u, v, camera)
    z = np.array([p[2] for p in around])
    if centre[2] <= 0 or (z <= (1 - STEEP) * centre[2]).any() or (z >= (1 + STEEP) * centre[2]).any():
        return None
    normal = np.cross(around[3] - around[2], around[1] - around[0])
    normal /= np.linalg.norm(normal)
    cosine = normal @ centre / np.linalg.norm(centre)
    return None if abs(cosine) <= MIN_COSINE else -np.sign(cosine) * normal


def matches(points, T_ij, depth, camera, limit):
    """Index of each point that matches, its residual in m, the derivative [6] by xi, the normal, and q."""
    fx, fy, cx, cy = camera
    height, width = depth.shape
    for k, p in enumerate(points):
        q = T_ij[:3, :3] @ p + T_ij[:3, 3]
        if q[2] <= 0.1:
            continue
        u, v = int(np.floor(fx * q[0] / q[2] + cx + 0.5)), int(np.floor(fy * q[1] / q[2] + cy + 0.5))
        if not (REACH <= u < width - REACH and REACH <= v < height - REACH):
            continue
        normal = normal_at(depth, u, v, camera)
        if normal is None:
            continue
        gap = q - surface(depth, u, v, camera)
        if np.linalg.norm(gap) < limit:
            m = T_ij[:3, :3].T @ normal
            yield k, normal @ gap, -np.concatenate([np.cross(p, m), m]), normal, q


def surface_distances(points, T_ij, depth, camera, depth_sigma, model_sigma, limit):
    """A [6, 6], b [6], squares, matches."""
    A, b, squares, count = np.zeros((6, 6)), np.zeros(6), 0.0, 0
    for _, e, j, normal, q in matches(points, T_ij, depth, camera, limit):
        variance = 2 * (depth_sigma * q[2] * (normal @ q)) ** 2 + model_sigma**2
        w = 1.0 / (1.0 + 0.25 * e * e / variance) / variance
        A += w * np.outer(j, j)
        b += w * e * j
        squares += w * e * e
        count += 1
    return A, b, squares, count
