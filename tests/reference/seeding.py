"""Cells of a quadtree in float64 NumPy: how far each is from plain and from planar."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CellMeasures:
    """By cell [rows, columns]; all but `complete` mean nothing where a cell is not complete."""

    complete: np.ndarray  # every pixel lies in the image and has depth
    on_plane: np.ndarray  # all pixels have the same plane id, not -1
    spread: np.ndarray  # largest standard deviation of a channel
    detrended: np.ndarray  # the same after a linear fit
    residual: np.ndarray  # RMS residual of the plane fit of inverse depth, 1/m


def cell_measures(colour, depth, ids, size):
    """Measures of the cells of size x size pixels, those that reach beyond the right and bottom included."""
    rows, columns = -(-depth.shape[0] // size), -(-depth.shape[1] // size)
    complete, on_plane = np.zeros((rows, columns), bool), np.zeros((rows, columns), bool)
    spread, detrended, residual = (np.zeros((rows, columns)) for _ in range(3))
    y, x = np.mgrid[:size, :size].reshape(2, -1)
    design = np.stack([np.ones(size * size), x, y], axis=1)
    for i, j in np.ndindex(rows, columns):
        at = np.s_[i * size : (i + 1) * size, j * size : (j + 1) * size]
        z = depth[at].ravel()
        if len(z) < size * size or (z <= 0).any():
            continue
        complete[i, j] = True
        on_plane[i, j] = (ids[at] == ids[at].flat[0]).all() and ids[at].flat[0] >= 0
        channels = colour[at].reshape(-1, 3)
        spread[i, j] = channels.std(axis=0).max()
        off = channels - design @ np.linalg.lstsq(design, channels, rcond=None)[0]
        detrended[i, j] = np.sqrt((off**2).mean(axis=0)).max()
        fit = design @ np.linalg.lstsq(design, 1 / z, rcond=None)[0]
        residual[i, j] = np.sqrt(np.mean((1 / z - fit) ** 2))
    return CellMeasures(complete, on_plane, spread, detrended, residual)
