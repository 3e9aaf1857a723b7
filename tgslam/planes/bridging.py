"""Pieces of one surface that something in front of it keeps apart are joined; surfaces with a gap between are not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tgslam.plane_fit import CellGrid, Floats, Labels
from tgslam.planes.merging import Agreement, Indices
from tgslam.planes.moments import Joints, planes_of

_SIGMAS = 3.0  # beyond which a measurement lies before or behind a plane
_RUN = 2  # samples one after the other off the plane: one alone is a border's ragged pixel
_OPEN_SHARE = 0.2  # of the ways between two pieces, that may be open: their borders need not be parallel
_CLOSED_SHARE = 0.5  # of the ways that have to be known to be closed; without measurements nothing is known
_SEEN_SHARE = 0.5  # of a way that is measured when it is known
_PARTED_SHARE = 0.5  # of the ways, on which something close before the plane may part it
_CLOSE_M = 0.15  # before a plane: a board between two fronts; what is farther off only hides part of the view
_REACH = 2.5  # a gap may be so many times as wide as the larger piece is (root of its area)
_LINKS = 48
_SAMPLES = 16  # along each link, or more where it is longer, in steps of at most a pixel
_MOST_SAMPLES = 64


@dataclass(frozen=True)
class Pieces:
    """Groups of cells with a plane each."""

    labels: Labels  # [rows, columns] of cells, -1 = none
    moments: Floats  # [G, 11] with the noise's variance


def bridge(
    pieces: Pieces, depth_m: NDArray[np.float32], grid: CellGrid, agreement: Agreement, across_area_m2: float
) -> Pieces:
    """Join the pieces that agree in their planes and that no view through keeps apart, those that agree best first.

    depth_m: host [H, W] m, 0 = none. across_area_m2: of two pieces with something else before the gap the larger one
    has to be as large; small things that happen to be level are as likely. The joined pieces are renumbered.
    """
    labels, moments = pieces.labels.copy(), pieces.moments.copy()
    size = len(moments)
    cost = np.full((size, size), np.inf)
    for a in range(size - 1):
        _compare(cost, moments, a, np.arange(a + 1, size), agreement)
    while np.isfinite(cost).any():
        a, b = (int(i) for i in np.unravel_index(np.argmin(cost), cost.shape))
        plane = planes_of(moments[None, a] + moments[None, b])[0]
        gap = _gap(labels == a, labels == b, plane, depth_m, grid, agreement.sigma)
        large = _area_m2(moments[[a, b]], plane, grid).max() >= across_area_m2
        if not (gap.closed and (large or gap.free)):
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
    joints = Joints.of(moments, *pairs)
    cost[tuple(pairs)] = np.where(agreement.admits(joints), joints.cost, np.inf)


def _area_m2(moments: Floats, plane: Floats, grid: CellGrid) -> Floats:
    """[N] of sets of points on one plane, as if each were at its centroid."""
    camera = grid.camera
    inverse_depth = moments[:, 6] / moments[:, 0]
    return moments[:, 0] / (inverse_depth**3 * _offset_m(plane, grid) * camera.fx * camera.fy)


def _offset_m(plane: Floats, grid: CellGrid) -> float:
    """Of a plane [3] from the camera."""
    return 1.0 / float(np.linalg.norm(plane[[1, 2, 0]] * np.array([grid.camera.fx, grid.camera.fy, 1.0])))


@dataclass(frozen=True)
class _Gap:
    """What is seen between two pieces of one plane."""

    closed: bool  # nothing behind the plane: they may be one surface
    free: bool  # nor, mostly, anything close before it that might part them


def _gap(
    first: NDArray[np.bool_],
    second: NDArray[np.bool_],
    plane: Floats,
    depth_m: NDArray[np.float32],
    grid: CellGrid,
    sigma: float,
) -> _Gap:
    """Look along the shortest ways between two pieces (masks of cells)."""
    ends = _links(first, second)
    if not len(ends):
        return _Gap(False, False)
    longest_px = float(np.abs(ends[:, 1] - ends[:, 0]).max()) * grid.cell_px
    along = np.linspace(0.0, 1.0, int(np.clip(longest_px, _SAMPLES, _MOST_SAMPLES)))[:, None, None]
    cells = ends[:, 0] + along * (ends[:, 1] - ends[:, 0])  # [S, L, 2] row, column
    inside = np.rint(cells * grid.cell_px + (grid.cell_px - 1) / 2).astype(int)
    v = np.minimum(inside[..., 0], depth_m.shape[0] - 1)
    u = np.minimum(inside[..., 1], depth_m.shape[1] - 1)
    between = ~(first | second)[v // grid.cell_px, u // grid.cell_px]
    z = depth_m[v, u].astype(np.float64)
    seen = between & (z > 0)
    measured = 1.0 / np.where(seen, z, 1.0)
    expected = plane[0] + plane[1] * (u - grid.camera.cx) + plane[2] * (v - grid.camera.cy)
    behind = seen & (measured - expected < -_SIGMAS * sigma)
    before_m = _offset_m(plane, grid) * (1.0 - expected / measured)
    close = seen & (measured - expected > _SIGMAS * sigma) & (before_m < _CLOSE_M)
    opened, parted = _run(behind), _run(behind | close)
    known = ~opened & (seen.sum(axis=0) >= _SEEN_SHARE * between.sum(axis=0))
    closed = opened.mean() <= _OPEN_SHARE and known.mean() >= _CLOSED_SHARE
    return _Gap(bool(closed), bool(parted.mean() <= _PARTED_SHARE))


def _run(samples: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[L] ways with several of the samples [S, L] one after the other."""
    windows = np.lib.stride_tricks.sliding_window_view(samples, _RUN, axis=0)
    return np.asarray(windows.all(axis=-1).any(axis=0))


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
