"""The graph that segmentation starts from: cells of pixels that a plane fits, and the pairs that adjoin."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from tgslam.ops import plane_fit
from tgslam.ops.plane_fit import CellGrid, Floats, Indices
from tgslam.planes.segmentation.moments import NOISE, Joints, squared_residuals, summed

_FEWEST = 6  # measurements of a cell: twice as many as a plane has parameters
_NOISIEST = 5.0  # times as noisy as the sensor should be, at most: what differs by more is no noise


@dataclass(frozen=True)
class CellGraph:
    """Planar cells as nodes; edges join neighbours on the four sides."""

    cell: Indices  # [N] index into the grid
    moments: Floats  # [N, 11] with the noise's variance
    edges: Indices  # [E, 2] nodes, the smaller first

    @cached_property
    def joints(self) -> Joints:
        """The sets of points at both ends of each edge [E], as one."""
        return Joints.of(self.moments, *self.edges.T)

    def squares(self, shape: tuple[int, int], side: int, sigmas: float) -> CellGraph:
        """The same of squares of `side` x `side` cells, all of them planar and on one plane as cells have to be.

        shape: rows and columns of cells. The squares that reach beyond are left out.
        """
        row, column = np.divmod(self.cell, shape[1])
        rows, columns = shape[0] // side, shape[1] // side
        inside = (row < rows * side) & (column < columns * side)
        square = (row // side * columns + column // side)[inside]
        moments = summed(self.moments[inside], square, rows * columns)
        whole = np.bincount(square, minlength=len(moments)) == side**2
        flat = whole & _fits(moments, moments[:, NOISE] / np.maximum(moments[:, 0], 1.0), sigmas)
        return CellGraph(np.flatnonzero(flat), moments[flat], _neighbours(flat.reshape(rows, columns)))


def planar_cells(depth_m: np.ndarray, grid: CellGrid, sigma: float, share: float, sigmas: float) -> CellGraph:
    """Cells of which at least that share is measured, and whose residual is at most so many times the noise.

    The noise is sigma, 1/m, or where neighbouring pixels differ by more at random, as much more as they do: shape does
    not look like that. An oblique step through a cell does, but not through most of the cells around it.
    """
    moments, white = plane_fit.cell_moments(depth_m, grid)
    white = np.minimum(white, median_filter(white.reshape(grid.shape), 3).ravel())
    variance = np.clip(white, sigma**2, (_NOISIEST * sigma) ** 2)
    count = moments[:, 0]
    flat = _fits(moments, variance, sigmas) & (count >= max(share * grid.cell_px**2, _FEWEST))
    cell = np.flatnonzero(flat)
    nodes = np.column_stack([moments[cell], count[cell] * variance[cell]])
    return CellGraph(cell, nodes, _neighbours(flat.reshape(grid.shape)))


def _fits(moments: Floats, variance: Floats, sigmas: float) -> NDArray[np.bool_]:
    """[N] whether sets of points leave residuals of at most so many times noise of that variance [N]."""
    return squared_residuals(moments) <= sigmas**2 * variance * np.maximum(moments[:, 0] - 3, 1.0)


def _neighbours(flat: NDArray[np.bool_]) -> Indices:
    """[E, 2] pairs of adjoining planar cells, numbered among the planar ones."""
    number = np.cumsum(flat).reshape(flat.shape) - 1
    beside = flat[:, :-1] & flat[:, 1:]
    below = flat[:-1] & flat[1:]
    across = np.stack([number[:, :-1][beside], number[:, 1:][beside]], axis=1)
    down = np.stack([number[:-1][below], number[1:][below]], axis=1)
    return np.concatenate([across, down])
