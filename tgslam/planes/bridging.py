"""Pieces of one surface that something in front of it keeps apart are joined; surfaces with a gap between are not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tgslam.plane_fit import CellGrid, Floats, Labels
from tgslam.planes.merging import Agreement, Indices
from tgslam.planes.moments import joining_cost, planes_of, squared_residuals

_SIGMAS = 4.0  # beyond which a measurement lies before or behind a plane
_BEHIND_SHARE = 0.1  # of what is seen between two pieces, that may lie behind their plane: borders are ragged
_SEEN_SHARE = 0.5  # between two pieces at least so much has to be measured: on their plane, or before it
_REACH = 1.0  # a gap may be so many times as wide as the larger piece is (root of its area)
_LINKS = 48
_SAMPLES = 16  # along each link


@dataclass(frozen=True)
class Pieces:
    """Groups of cells with a plane each."""

    labels: Labels  # [rows, columns] of cells, -1 = none
    moments: Floats  # [G, 11] with the noise's variance


def bridge(pieces: Pieces, depth_m: NDArray[np.float32], grid: CellGrid, agreement: Agreement) -> Pieces:
    """Join the pieces that agree in their planes and between which nothing lies behind, those that agree best first.

    depth_m: host [H, W] m, 0 = none. The joined pieces are renumbered.
    """
    labels, moments = pieces.labels.copy(), pieces.moments.copy()
    size = len(moments)
    cost = np.full((size, size), np.inf)
    for a in range(size - 1):
        _compare(cost, moments, a, np.arange(a + 1, size), agreement)
    while np.isfinite(cost).any():
        a, b = (int(i) for i in np.unravel_index(np.argmin(cost), cost.shape))
        plane = planes_of(moments[None, a] + moments[None, b])[0]
        if not _continuous(labels == a, labels == b, plane, depth_m, grid, agreement.sigma):
            cost[a, b] = np.inf
            continue
        labels[labels == b] = a
        moments[a] += moments[b]
        moments[b] = 0.0
        cost[b] = cost[:, b] = np.inf
        others = np.flatnonzero((moments[:, 0] > 0) & (np.arange(size) != a))
        _compare(cost, moments, a, others, agreement)
    alive = np.flatnonzero(moments[:, 0] > 0)
    number = np.full(size + 1, -1, np.int32)
    number[alive] = np.arange(len(alive))
    return Pieces(number[labels], moments[alive])


def _compare(cost: Floats, moments: Floats, piece: int, others: Indices, agreement: Agreement) -> None:
    """Write what joining a piece to others costs, above the diagonal of `cost` [G, G]; infinite where they disagree."""
    pairs = np.stack([np.minimum(piece, others), np.maximum(piece, others)])
    found = joining_cost(moments, squared_residuals(moments), *pairs)
    cost[tuple(pairs)] = np.where(agreement.admits(found, moments[pairs[0]], moments[pairs[1]]), found, np.inf)


def _continuous(
    first: NDArray[np.bool_],
    second: NDArray[np.bool_],
    plane: Floats,
    depth_m: NDArray[np.float32],
    grid: CellGrid,
    sigma: float,
) -> bool:
    """Whether what is seen between two pieces (masks of cells) lets them be one surface."""
    ends = _links(first, second)
    if not len(ends):
        return False
    along = np.linspace(0.0, 1.0, _SAMPLES)[:, None, None]
    cells = ends[:, 0] + along * (ends[:, 1] - ends[:, 0])  # [S, L, 2] row, column
    inside = np.rint(cells * grid.cell_px + (grid.cell_px - 1) / 2).astype(int)
    v = np.minimum(inside[..., 0], depth_m.shape[0] - 1)
    u = np.minimum(inside[..., 1], depth_m.shape[1] - 1)
    between = ~(first | second)[v // grid.cell_px, u // grid.cell_px]
    z = depth_m[v, u][between].astype(np.float64)
    expected = (plane[0] + plane[1] * (u - grid.camera.cx) + plane[2] * (v - grid.camera.cy))[between]
    seen = z > 0
    behind = seen & (1.0 / np.where(seen, z, 1.0) < expected - _SIGMAS * sigma)
    return bool(behind.sum() <= _BEHIND_SHARE * between.sum() and (seen & ~behind).sum() >= _SEEN_SHARE * between.sum())


def _links(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> Floats:
    """[L, 2, 2] the shortest ways from the smaller piece's rim to the larger one's: row and column of both cells."""
    small, large = (first, second) if first.sum() <= second.sum() else (second, first)
    start, target = _rim(small), _rim(large)
    distance, nearest = cKDTree(target).query(start)
    if distance.min() > _REACH * np.sqrt(large.sum()):
        return np.empty((0, 2, 2))
    near = np.flatnonzero(distance <= 1.5 * distance.min() + 2.0)
    near = near[:: -(-len(near) // _LINKS)]
    return np.stack([start[near], target[nearest[near]]], axis=1)


def _rim(mask: NDArray[np.bool_]) -> Indices:
    """[R, 2] row and column of the cells that have a neighbour outside."""
    around = np.pad(mask, 1)
    inner = around[:-2, 1:-1] & around[2:, 1:-1] & around[1:-1, :-2] & around[1:-1, 2:]
    return np.argwhere(mask & ~inner)
