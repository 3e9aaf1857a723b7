"""The graph that segmentation starts from: cells of pixels that a plane fits, and the pairs that adjoin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam import plane_fit
from tgslam.plane_fit import CellGrid, Floats
from tgslam.planes.moments import squared_residuals

Indices = NDArray[np.intp]


@dataclass(frozen=True)
class CellGraph:
    """Planar cells as nodes; edges join neighbours on the four sides."""

    cell: Indices  # [N] index into the grid
    moments: Floats  # [N, 10]
    edges: Indices  # [E, 2] nodes, the smaller first


def planar_cells(depth_m: np.ndarray, grid: CellGrid, sigma: float, share: float, sigmas: float) -> CellGraph:
    """Cells of which at least that share is measured, and whose residual is at most so many sigma (1/m)."""
    moments = plane_fit.cell_moments(depth_m, grid)
    count = moments[:, 0]
    freedom = np.maximum(count - 3, 1.0)
    flat = (count >= max(share * grid.cell_px**2, 6)) & (squared_residuals(moments) <= (sigmas * sigma) ** 2 * freedom)
    cell = np.flatnonzero(flat)
    return CellGraph(cell, moments[cell], _neighbours(flat.reshape(grid.shape)))


def _neighbours(flat: NDArray[np.bool_]) -> Indices:
    """[E, 2] pairs of adjoining planar cells, numbered among the planar ones."""
    number = np.cumsum(flat).reshape(flat.shape) - 1
    beside = flat[:, :-1] & flat[:, 1:]
    below = flat[:-1] & flat[1:]
    across = np.stack([number[:, :-1][beside], number[:, 1:][beside]], axis=1)
    down = np.stack([number[:-1][below], number[1:][below]], axis=1)
    return np.concatenate([across, down])
