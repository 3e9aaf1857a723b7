"""Cells of a quadtree in float64 NumPy: how far each is from plain and from planar."""

import numpy as np


def cell_measures(colour, depth, size):
    """By cell: whether it is complete, the largest standard deviation of a channel, the plane's RMS residual in 1/m.

    Cells at the right and bottom that reach beyond the image are not complete.
    """
    rows, columns = -(-depth.shape[0] // size), -(-depth.shape[1] // size)
    complete, spread, residual = np.zeros((rows, columns), bool), np.zeros((rows, columns)), np.zeros((rows, columns))
    y, x = np.mgrid[:size, :size].reshape(2, -1)
    design = np.stack([np.ones(size * size), x, y], axis=1)
    for i, j in np.ndindex(rows, columns):
        at = np.s_[i * size : (i + 1) * size, j * size : (j + 1) * size]
        z = depth[at].ravel()
        if len(z) < size * size or (z <= 0).any():
            continue
        complete[i, j] = True
        spread[i, j] = colour[at].reshape(-1, 3).std(axis=0).max()
        fit = design @ np.linalg.lstsq(design, 1 / z, rcond=None)[0]
        residual[i, j] = np.sqrt(np.mean((1 / z - fit) ** 2))
    return complete, spread, residual
