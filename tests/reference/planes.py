"""Plane kernels in float64 NumPy, pixel by pixel."""

import numpy as np


def features(x, y, w):
    return np.array([1.0, x, y, x * x, x * y, y * y, w, x * w, y * w, w * w])


def blocks(shape, cell):
    """Row and column of each cell, and its pixels as (v, u)."""
    for i in range(-(-shape[0] // cell)):
        for j in range(-(-shape[1] // cell)):
            rows = range(i * cell, min((i + 1) * cell, shape[0]))
            columns = range(j * cell, min((j + 1) * cell, shape[1]))
            yield i, j, [(v, u) for v in rows for u in columns]


def misfit(depth, plane, v, u, cx, cy):
    return 1.0 / depth[v, u] - (plane[0] + plane[1] * (u - cx) + plane[2] * (v - cy))


def cell_moments(depth, cell, cx, cy):
    """[C, 10] about the principal point."""
    found = []
    for _, _, pixels in blocks(depth.shape, cell):
        rows = [features(u - cx, v - cy, 1.0 / depth[v, u]) for v, u in pixels if depth[v, u] > 0]
        found.append(np.sum(rows, axis=0) if rows else np.zeros(10))
    return np.array(found)


def white_noise(depth, cell):
    """[C] a quarter of the mean squared twist of 2 x 2 pixels."""
    found = []
    for _, _, pixels in blocks(depth.shape, cell):
        squares = []
        for v, u in pixels:
            square = depth[v : v + 2, u : u + 2]
            if {(v + 1, u), (v, u + 1)} <= set(pixels) and (square > 0).all():
                squares.append((1 / square[0, 0] - 1 / square[0, 1] - 1 / square[1, 0] + 1 / square[1, 1]) ** 2)
        found.append(np.mean(squares) / 4.0 if squares else 0.0)
    return np.array(found)


def candidates(labels, most=4):
    """[C] lists: labels of a cell, its four sides and its four corners, each once."""
    around = np.pad(labels, 1, constant_values=-1)
    steps = ((0, 0), (-1, 0), (0, -1), (0, 1), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1))
    found = []
    for i, j in np.ndindex(*labels.shape):
        near = [around[i + 1 + y, j + 1 + x] for y, x in steps]
        found.append(list(dict.fromkeys(int(k) for k in near if k >= 0))[:most])
    return found


def window_misfit(depth, plane, v, u, cx, cy, tolerance):
    near = [(r, s) for r in range(v - 2, v + 3) for s in range(u - 2, u + 3)]
    inside = [(r, s) for r, s in near if 0 <= r < depth.shape[0] and 0 <= s < depth.shape[1] and depth[r, s] > 0]
    return sum(min(abs(misfit(depth, plane, r, s, cx, cy)), tolerance) ** 2 for r, s in inside)


def label_pixels(depth, cell, cx, cy, cell_labels, planes, tolerance):
    """[H, W]: the candidate that fits the pixel, and of several the one that fits its 5 x 5 surroundings best."""
    labels = np.full(depth.shape, -1)
    found = candidates(cell_labels)
    for i, j, pixels in blocks(depth.shape, cell):
        near = found[i * cell_labels.shape[1] + j]
        for v, u in pixels:
            if depth[v, u] > 0:
                fit = [k for k in near if abs(misfit(depth, planes[k], v, u, cx, cy)) <= tolerance[k]]
                if fit:
                    labels[v, u] = min(fit, key=lambda k: window_misfit(depth, planes[k], v, u, cx, cy, tolerance[k]))
    return labels


def alike(labels):
    """[H, W] how many of 8 neighbours share the label; beyond the border the image goes on as at the border."""
    around = np.pad(labels, 1, mode="edge")
    count = np.zeros(labels.shape, int)
    for v, u in np.ndindex(*labels.shape):
        count[v, u] = (around[v : v + 3, u : u + 3] == labels[v, u]).sum() - 1
    return count


def drop_lonely(labels):
    """Labels that at least 3 of 8 neighbours share."""
    return np.where(alike(labels) >= 3, labels, -1)


def segment_sums(depth, cell, cx, cy, planes, labels, scale):
    """{(cell, plane): (weighted moments [10] about the principal point, pixels, squared misfits)}.

    Pixels beside others of another label weigh a tenth.
    """
    found, rim = {}, alike(labels) < 8
    columns = -(-depth.shape[1] // cell)
    for i, j, pixels in blocks(depth.shape, cell):
        for v, u in pixels:
            k = int(labels[v, u])
            if k >= 0:
                r = misfit(depth, planes[k], v, u, cx, cy)
                row = features(u - cx, v - cy, r) * (0.1 if rim[v, u] else 1.0) / np.sqrt(1.0 + (r / scale) ** 2)
                old = found.get((i * columns + j, k), (np.zeros(10), 0, 0.0))
                found[i * columns + j, k] = (old[0] + row, old[1] + 1, old[2] + r * r)
    return found
