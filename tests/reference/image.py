"""Image operations in float64 NumPy, written for clarity."""

import numpy as np


def luminance(colour):
    return colour @ np.array([0.299, 0.587, 0.114])


def halve(image):
    height, width = image.shape[0] // 2, image.shape[1] // 2
    image = image[: 2 * height, : 2 * width]
    return (image[::2, ::2] + image[::2, 1::2] + image[1::2, ::2] + image[1::2, 1::2]) / 4


def halve_depth(depth, relative):
    half = np.zeros((depth.shape[0] // 2, depth.shape[1] // 2))
    for i, j in np.ndindex(half.shape):
        block = depth[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
        found = block[block > 0]
        if len(found):
            half[i, j] = 1 / (1 / found[found <= found.min() * (1 + relative)]).mean()
    return half


def sobel(image):
    p = np.pad(image, 1, mode="edge")
    smooth_rows = p[:-2] + 2 * p[1:-1] + p[2:]
    smooth_columns = p[:, :-2] + 2 * p[:, 1:-1] + p[:, 2:]
    return (smooth_rows[:, 2:] - smooth_rows[:, :-2]) / 8, (smooth_columns[2:] - smooth_columns[:-2]) / 8


def texture_gate(grey, percentile, noise_floor):
    strength = np.hypot(*sobel(grey))
    step = max(1, min(grey.shape) // 120)
    low, high = np.percentile(strength[::step, ::step], (100 - percentile, percentile))
    return 1 - np.clip((strength - low) / (high - low + noise_floor), 0, 1)


def block_inverse_depth(depth, relative):
    height, width = depth.shape
    blocks = np.zeros((height // 2, width // 2))
    for i, j in np.ndindex(blocks.shape):
        block = depth[2 * i : 2 * i + 2, 2 * j : 2 * j + 2]
        inverse = 1 / block[block > 0]
        if len(inverse):
            blocks[i, j] = inverse[inverse >= inverse.max() * (1 - relative)].mean()
    return blocks


def normals(depth, camera, radius, sigma, steepest_rad, relative):
    blocks = block_inverse_depth(depth, relative)
    out = np.zeros((*depth.shape, 3))
    for i, j in np.ndindex(blocks.shape):
        fit = _fit(blocks, i, j, radius, sigma, 2 * np.tan(steepest_rad) / min(camera.fx, camera.fy))
        if fit is None:
            continue
        w0, wx, wy = fit
        v0, u0 = 2 * i + 0.5, 2 * j + 0.5
        outward = np.array([wx * camera.fx, wy * camera.fy, w0 - wx * (u0 - camera.cx) - wy * (v0 - camera.cy)])
        for v in range(2 * i, 2 * i + 2 if i + 1 < len(blocks) else depth.shape[0]):
            for u in range(2 * j, 2 * j + 2 if j + 1 < blocks.shape[1] else depth.shape[1]):
                expected = w0 + wx * (u - u0) + wy * (v - v0)
                if depth[v, u] > 0 and abs(1 / depth[v, u] - expected) <= 4 * sigma + 0.01 * w0:
                    out[v, u] = -outward / np.linalg.norm(outward)
    return out


def _fit(blocks, i, j, radius, sigma, slope):
    """Inverse depth and its slopes per pixel at the middle of a block, or None."""
    centre = blocks[i, j]
    if centre <= 0:
        return None
    rows, columns = np.mgrid[
        max(i - radius, 0) : min(i + radius + 1, blocks.shape[0]),
        max(j - radius, 0) : min(j + radius + 1, blocks.shape[1]),
    ]
    y, x, w = rows - i, columns - j, blocks[rows, columns]
    like = (w > 0) & (abs(w - centre) <= 4 * sigma + slope * centre * np.maximum(abs(x), abs(y)))
    if like.sum() < max(0.3 * (2 * radius + 1) ** 2, 4):
        return None
    design = np.stack([np.ones(like.sum()), x[like], y[like]], axis=1)
    if np.linalg.matrix_rank(design) < 3:
        return None
    solution = np.linalg.lstsq(design, w[like], rcond=None)[0]
    residual = np.mean((design @ solution - w[like]) ** 2)
    if solution[0] <= 0 or residual > 4 * sigma**2 + 1e-5 * solution[0] ** 2:
        return None
    return solution[0], solution[1] / 2, solution[2] / 2


def mean_around(image):
    """Mean of 3x3 pixels, borders repeated."""
    p = np.pad(image, 1, mode="edge")
    rows = p[:-2] + p[1:-1] + p[2:]
    return (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9


def rim(half_cover, whole, shape):
    """Where an image [H, W] of that shape is covered less than `whole` in the mean over 3x3 blocks of 2x2 pixels."""
    rows = np.minimum(np.arange(shape[0]) // 2, half_cover.shape[0] - 1)
    columns = np.minimum(np.arange(shape[1]) // 2, half_cover.shape[1] - 1)
    return (mean_around(half_cover) < whole)[np.ix_(rows, columns)]


def adopted_normals(surface, planes, camera, sigma, least_cosine, slack_m, sigmas):
    """Normals [H, W, 3] of surface [H, W, 4], each the nearest plane's where it lies on one."""
    out = surface[..., :3].copy()
    for v, u in np.ndindex(out.shape[:2]):
        z, ray = surface[v, u, 3], np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
        nearest = slack_m + sigmas * sigma * z**2
        for plane in planes:
            off = abs(z * (plane[:3] @ ray) + plane[3])
            if off < nearest and surface[v, u, :3] @ plane[:3] > least_cosine:
                nearest, out[v, u] = off, plane[:3]
    return out
