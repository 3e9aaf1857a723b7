"""Depth registered to colour in float64 NumPy."""

import numpy as np

RIM = 1e-4


def agree(first, second, sigma_per_m2, tolerance_sigmas, slope):
    z = min(first, second)
    return z > 0 and abs(first - second) < (tolerance_sigmas * sigma_per_m2 * z + slope) * z


def register(depth, rays, T_cd, camera, shape, sigma_per_m2, tolerance_sigmas, slope):
    """depth: [H, W]; rays: [H, W, 2]; T_cd: [3, 4]; camera: fx, fy, cx, cy; shape: of the colour image."""
    settings = sigma_per_m2, tolerance_sigmas, slope
    points_c = np.concatenate([rays, np.ones((*depth.shape, 1))], -1) * depth[..., None] @ T_cd[:, :3].T + T_cd[:, 3]
    z = np.where((depth > 0) & (points_c[..., 2] > 1e-3), points_c[..., 2], 0.0)
    safe = np.where(z > 0, z, 1.0)
    u = camera[0] * points_c[..., 0] / safe + camera[2]
    v = camera[1] * points_c[..., 1] / safe + camera[3]
    placed = np.stack([u, v, z], -1)

    surfaces, points = np.full(shape, np.inf), np.full(shape, np.inf)
    for y, x in np.ndindex(depth.shape[0] - 1, depth.shape[1] - 1):
        around = [(y, x), (y, x + 1), (y + 1, x + 1), (y + 1, x)]
        whole = all(
            placed[p][2] > 0 and agree(depth[p], depth[q], *settings)
            for p, q in zip(around, around[1:] + around[:1], strict=True)
        )
        for k in range(4):
            p, q, r = (around[(k + n) % 4] for n in range(3))
            one = agree(depth[p], depth[q], *settings) and agree(depth[q], depth[r], *settings)
            one = one and agree(depth[r], depth[p], sigma_per_m2, tolerance_sigmas, 2 * slope)
            if one and min(placed[p][2], placed[q][2], placed[r][2]) > 0 and (not whole or k % 2 == 0):
                draw(placed[p], placed[q], placed[r], surfaces)
    for y, x in np.argwhere(z > 0):
        column, row = int(np.floor(u[y, x] + 0.5)), int(np.floor(v[y, x] + 0.5))
        if 0 <= row < shape[0] and 0 <= column < shape[1]:
            points[row, column] = min(points[row, column], z[y, x])

    registered = np.where(np.isfinite(points), points, 0.0)
    for y, x in np.argwhere(np.isfinite(surfaces)):
        point, surface = points[y, x], surfaces[y, x]
        if not (point < surface and not agree(point, surface, *settings)):
            registered[y, x] = surface
    return registered


def draw(a, b, c, nearest):
    """Inverse depth is linear over the triangle; one that is seen from behind is left out."""
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if area <= 1e-6:
        return
    low, high = np.min([a, b, c], axis=0), np.max([a, b, c], axis=0)
    for v in range(max(int(np.ceil(low[1] - RIM)), 0), min(int(np.floor(high[1] + RIM)), nearest.shape[0] - 1) + 1):
        for u in range(max(int(np.ceil(low[0] - RIM)), 0), min(int(np.floor(high[0] + RIM)), nearest.shape[1] - 1) + 1):
            of_b, of_c = np.linalg.solve([[b[0] - a[0], c[0] - a[0]], [b[1] - a[1], c[1] - a[1]]], [u - a[0], v - a[1]])
            of_a = 1 - of_b - of_c
            if min(of_a, of_b, of_c) >= -RIM:
                nearest[v, u] = min(nearest[v, u], 1 / (of_a / a[2] + of_b / b[2] + of_c / c[2]))
