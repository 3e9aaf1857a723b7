"""Pieces of one surface that something in front of it keeps apart are joined; surfaces with a gap between are not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tgslam.config.plane_settings import GapSettings
from tgslam.ops.plane_fit import CellGrid, Floats, Indices, Labels
from tgslam.planes.segmentation.merging import Agreement
from tgslam.planes.segmentation.moments import Joints, planes_of

_SIGMAS = 3.0  # of a pixel's noise, beyond which a measurement lies before or behind a plane
_OPEN_SHARE = 0.2  # of the ways between two pieces, that may be open: their borders need not be parallel
_CLOSED_SHARE = 0.5  # of the ways that have to be known to be closed; without measurements nothing is known
_SEEN_SHARE = 0.5  # of a way that is measured when it is known
_PARTED_SHARE = 0.5  # of the ways, on which something close before the plane may part it
_REACH = 2.5  # a gap may be so many times as wide as the larger piece is (root of its area)
_LINKS = 48  # ways at most that are looked along, from all along a gap
_SAMPLES = 16  # along each link, or more where it is longer, in steps of at most a pixel
_MOST_SAMPLES = 64  # along a link, which bounds the time that a gap takes


@dataclass(frozen=True)
class Pieces:
    """Groups of cells with a plane each."""

    labels: Labels  # [rows, columns] of cells, -1 = none
    moments: Floats  # [G, 11] with the noise's variance


def bridge(
    pieces: Pieces, depth_m: NDArray[np.float32], grid: CellGrid, agreement: Agreement, config: GapSettings
) -> Pieces:
    """Join the pieces that agree in their planes and that no view through keeps apart, those that agree best first.

    depth_m: host [H, W] m, 0 = none. Of two pieces with something else close before the gap, the larger one has to be
    large: small things that happen to be level are as likely. The joined pieces are renumbered.
    """
    moments, size = pieces.moments.copy(), len(pieces.moments)
    outlines = _Outlines(pieces.labels)
    cost = np.full((size, size), np.inf)
    _compare(cost, moments, *np.triu_indices(size, 1), agreement)
    while np.isfinite(cost).any():
        a, b = (int(i) for i in np.unravel_index(np.argmin(cost), cost.shape))
        plane = planes_of(moments[None, a] + moments[None, b])[0]
        gap = _gap(outlines, a, b, plane, depth_m, grid, agreement.sigma, config.close_before_m)
        large = gap.closed and _area_m2(moments[[a, b]], plane, grid).max() >= config.across_area_m2
        if not (gap.closed and (large or gap.free)):
            cost[a, b] = np.inf
            continue
        outlines.join(a, b)
        moments[a] += moments[b]
        moments[b] = 0.0
        cost[b] = cost[:, b] = np.inf
        others = np.flatnonzero((moments[:, 0] > 0) & (np.arange(size) != a))
        _compare(cost, moments, np.minimum(a, others), np.maximum(a, others), agreement)
    alive = np.flatnonzero(moments[:, 0] > 0)
    number = np.full(size + 1, -1, np.int32)
    number[alive] = np.arange(len(alive))
    return Pieces(number[outlines.labels], moments[alive])


def _compare(cost: Floats, moments: Floats, first: Indices, second: Indices, agreement: Agreement) -> None:
    """Write what joining pairs of pieces costs, first < second, to `cost` [G, G]; infinite where they disagree."""
    joints = Joints.of(moments, first, second)
    cost[first, second] = np.where(agreement.admits(joints), joints.cost, np.inf)


def _area_m2(moments: Floats, plane: Floats, grid: CellGrid) -> Floats:
    """[N] of sets of points on one plane, as if each were at its centroid."""
    camera = grid.camera
    inverse_depth = moments[:, 6] / moments[:, 0]
    return moments[:, 0] / (inverse_depth**3 * _offset_m(plane, grid) * camera.fx * camera.fy)


def _offset_m(plane: Floats, grid: CellGrid) -> float:
    """Of a plane [3] from the camera."""
    return 1.0 / float(np.linalg.norm(plane[[1, 2, 0]] * np.array([grid.camera.fx, grid.camera.fy, 1.0])))


class _Outlines:
    """Where pieces are, and the shortest ways from rim to rim."""

    def __init__(self, labels: Labels) -> None:
        """labels: [rows, columns] pieces of the cells, -1 = none."""
        self._padded = np.pad(labels, 1, constant_values=-1)
        self.labels = self._padded[1:-1, 1:-1]
        self._cells = np.bincount(labels.ravel() + 1)[1:]
        self._rims: dict[int, tuple[Indices, cKDTree]] = {}  # those that have been asked for

    def join(self, kept: int, gone: int) -> None:
        """The cells of one piece are another one's."""
        self.labels[self.labels == gone] = kept
        self._cells[kept] += self._cells[gone]
        self._rims.pop(kept, None)

    def links(self, first: int, second: int) -> Floats:
        """[L, 2, 2] the shortest ways from the smaller piece's rim to the larger one's: row and column of both cells.

        None where the gap is too wide for the pieces.
        """
        small, large = (first, second) if self._cells[first] <= self._cells[second] else (second, first)
        (start, _), (target, tree) = self._rim(small), self._rim(large)
        distance, nearest = tree.query(start)
        least = distance.min()
        if least > _REACH * np.sqrt(self._cells[large]):
            return np.empty((0, 2, 2))
        near = np.flatnonzero(distance <= 1.5 * least + 2.0)
        near = near[:: -(-len(near) // _LINKS)]
        return np.stack([start[near], target[nearest[near]]], axis=1)

    def _rim(self, piece: int) -> tuple[Indices, cKDTree]:
        """[R, 2] row and column of the cells of a piece that have a side on no cell of it; also as a tree."""
        if piece not in self._rims:
            own = self._padded == piece
            inner = own[:-2, 1:-1] & own[2:, 1:-1] & own[1:-1, :-2] & own[1:-1, 2:]
            cells = np.argwhere(own[1:-1, 1:-1] & ~inner)
            self._rims[piece] = cells, cKDTree(cells)
        return self._rims[piece]


@dataclass(frozen=True)
class _Gap:
    """What is seen between two pieces of one plane."""

    closed: bool  # nothing behind the plane: they may be one surface
    free: bool  # nor, mostly, anything close before it that might part them


def _gap(
    outlines: _Outlines,
    first: int,
    second: int,
    plane: Floats,
    depth_m: NDArray[np.float32],
    grid: CellGrid,
    sigma: float,
    close_m: float,
) -> _Gap:
    """Look along the shortest ways between two pieces. close_m: as of `GapSettings`."""
    ends = outlines.links(first, second)
    if not len(ends):
        return _Gap(False, False)
    longest_px = float(np.abs(ends[:, 1] - ends[:, 0]).max()) * grid.cell_px
    along = np.linspace(0.0, 1.0, int(np.clip(longest_px, _SAMPLES, _MOST_SAMPLES)))[:, None, None]
    cells = ends[:, 0] + along * (ends[:, 1] - ends[:, 0])  # [S, L, 2] row, column
    inside = np.rint(cells * grid.cell_px + (grid.cell_px - 1) / 2).astype(int)
    v = np.minimum(inside[..., 0], depth_m.shape[0] - 1)
    u = np.minimum(inside[..., 1], depth_m.shape[1] - 1)
    piece = outlines.labels[v // grid.cell_px, u // grid.cell_px]
    between = (piece != first) & (piece != second)
    z = depth_m[v, u].astype(np.float64)
    seen = between & (z > 0)
    measured = 1.0 / np.where(seen, z, 1.0)
    expected = plane[0] + plane[1] * (u - grid.camera.cx) + plane[2] * (v - grid.camera.cy)
    behind = seen & (measured - expected < -_SIGMAS * sigma)
    opened = _run(behind)
    known = ~opened & (seen.sum(axis=0) >= _SEEN_SHARE * between.sum(axis=0))
    if opened.mean() > _OPEN_SHARE or known.mean() < _CLOSED_SHARE:
        return _Gap(False, False)
    before_m = _offset_m(plane, grid) * (1.0 - expected / measured)
    close = seen & (measured - expected > _SIGMAS * sigma) & (before_m < close_m)
    return _Gap(True, bool(_run(behind | close).mean() <= _PARTED_SHARE))


def _run(samples: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """[L] ways with two of the samples [S, L] one after the other: one alone is a border's ragged pixel."""
    return np.asarray((samples[1:] & samples[:-1]).any(axis=0))
