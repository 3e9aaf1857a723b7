"""Surfaces a little before or behind a larger one, as skirting boards and panels are, out of which agglomeration grows.

Single cells do not tell such a step from noise, and so may join the larger surface. Held against its plane, all of them
stand off it the same way.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tgslam.config.plane_settings import StepSettings
from tgslam.ops.plane_fit import Floats, Indices, Labels
from tgslam.planes.segmentation.cells import CellGraph
from tgslam.planes.segmentation.merging import Agreement
from tgslam.planes.segmentation.moments import NOISE, Joints, information, planes_of, summed, width_px

_WINDOW_CELLS = 3  # side of the squares over which misfits are averaged: the smallest with a cell in its middle
_LINE_CELLS, _LINE_WIDTH_CELLS = 11, 1.5  # length and width of the lines over which they are, to find strips
_LINE_DIRECTIONS = 8  # of lines: the ends of one are at most a cell away from a strip through its middle
_TYPICAL = 0.75  # quantile of the misfits of such cells that is the step's: those at its border have less
_DEVIATION = 1.4826  # standard deviations that a median of magnitudes stands for
_ROUNDS = 3  # of settling at most: a cell follows its neighbours by so many
_NEIGHBOUR = 6.0  # squared sigmas of misfit that a neighbour of the same surface is worth
_LARGE = 6.0  # likewise, that the surface is large, and needs no plane of its own
_LARGER = 4.0  # times as many points has a surface that another one is taken to be parallel to
_MIXED_SHARE = 0.25  # of a small group's nodes, that another plane fits better: fewer are noise
_NARROW_CELLS = 5  # wide is a strip that may seem turned by as much as surfaces stray from planes
_FEWEST_PX = 6.0  # of what is compared: twice as many as a plane has parameters
_STEP_M = 0.1  # along the line of sight at most: what stands farther before a surface need not be parallel to it


def part_layers(
    graph: CellGraph,
    shape: tuple[int, int],
    group: Indices,
    agreement: Agreement,
    least_px: float,
    config: StepSettings,
) -> tuple[Indices, Indices]:
    """The group of each node [N], -1 = none, where parts of a group that stand off its plane are groups of their own.

    A part is connected, of one side of the plane, at least `least_px` points, and its plane does not agree with that of
    the rest. shape: rows and columns of cells. Returns with the group [G] out of which each strip was taken, -1 for all
    others: cell by cell, strips would be given back.
    """
    group, moments = group.copy(), group_moments(graph, group)
    misfit = _misfits(graph, planes_of(moments)[group])
    parents: dict[int, int] = {}
    for find in (_standing_off, _strips):
        for index in np.flatnonzero(moments[:, 0] > 2 * least_px):
            nodes = np.flatnonzero(group == index)
            for part in find(misfit[nodes], graph.cell[nodes], shape, graph.moments[nodes, 0], least_px, config):
                chosen = graph.moments[nodes[part]].sum(axis=0)
                pair = np.stack([chosen, moments[index] - chosen])
                if chosen[0] >= least_px and not _agree(pair, agreement):
                    new = int(group.max()) + 1
                    group[nodes[part]] = new
                    if find is _strips:
                        parents[new] = int(index)
    parent = _no_parents(group)
    parent[list(parents)] = list(parents.values())
    return group, parent


def settle(
    graph: CellGraph, shape: tuple[int, int], group: Indices, large_px: float, parent: Indices | None = None
) -> Indices:
    """The group [N] of each node, where it belongs to that one whose plane it fits best, its neighbours having a say.

    It may change to the groups of its neighbours, and to all of more than `large_px` points: those go on behind things.
    Parts that are not connected are groups of their own then. -1 stays -1. parent: [G] the group that each one's nodes
    do not change to, see `part_layers`.
    """
    parent = _no_parents(group) if parent is None else parent
    group = _unmixed(graph, group, large_px, parent)
    grid = np.full(shape, -1, np.intp)
    for _ in range(_ROUNDS):
        moments = group_moments(graph, group)
        is_large = moments[:, 0] > large_px
        grid.ravel()[graph.cell] = group
        around = _around(grid)[:, graph.cell]
        others = ((around != group) & (around >= 0)).any(axis=0) | ~is_large[group]
        open_ = np.flatnonzero((group >= 0) & others)
        settled = group.copy()
        settled[open_] = _choice(
            graph.moments[open_], group[open_], around[:, open_], is_large, planes_of(moments), parent
        )
        if (settled == group).all():
            break
        group = settled
    return _connected(graph, shape, group)


def _unmixed(graph: CellGraph, group: Indices, large_px: float, parent: Indices) -> Indices:
    """The group [N] of each node, where those of small groups that a large one's plane fits better are that one's.

    A small group that is partly on a large plane, partly a little before it, has a plane between the two that fits
    neither, and no neighbour speaks against it where something hides how the large surface goes on.
    """
    for _ in range(_ROUNDS):
        moments = group_moments(graph, group)
        is_large = moments[:, 0] > large_px
        open_ = np.flatnonzero((group >= 0) & ~is_large[group])
        around = np.full((0, len(open_)), -1, np.intp)
        chosen = _choice(graph.moments[open_], group[open_], around, is_large, planes_of(moments), parent, 0.0)
        left = np.bincount(group[open_][chosen != group[open_]], minlength=len(moments))
        mixed = left > _MIXED_SHARE * np.bincount(group[open_], minlength=len(moments))
        if not mixed.any():
            break
        group = group.copy()
        group[open_] = np.where(mixed[group[open_]], chosen, group[open_])
    return group


def parallel(
    planes: Floats, moments: Floats, pairs: Indices, agreement: Agreement, cell_px: int
) -> tuple[Floats, dict[int, int], list[tuple[int, int]]]:
    """The planes [P, 3], where those that do not differ from a larger neighbour but by a small step are parallel to it.

    A narrow strip hardly tells how it is turned about its length, and what its borders take in from the surfaces beside
    it turns it: what is fixed to a wall mostly is as the wall is. moments: [P, 11] of the points that the planes were
    fitted to. pairs: [K, 2] of planes that adjoin, see `bordering`. Returns with the larger one by the smaller
    one that is parallel to it, and the pairs (smaller, larger) that a step parts: more of it than the sensor may feign
    or a surface may have.
    """
    size_px = moments[:, 0]
    beside = (size_px[pairs[:, 1]] >= _LARGER * size_px[pairs[:, 0]]) & (size_px[pairs[:, 0]] >= _FEWEST_PX)
    small, large = pairs[beside].T
    count, own, reference = size_px[small], planes[small], planes[large]
    weight = information(moments[small])
    weighted = np.einsum("kij,kj->ki", weight, reference)
    size = np.sum(reference * weighted, axis=1)
    scale = np.sum(own * weighted, axis=1) / size
    depth_m = count / np.maximum(np.sum(weight[:, 0] * own, axis=1), 1e-9)
    rest = own - scale[:, None] * reference
    noise = agreement.sigmas**2 * moments[small, NOISE] / count + agreement.common
    shift = (agreement.shift_m / depth_m**2) ** 2 * count
    allowed = noise + np.where(width_px(moments[small]) <= _NARROW_CELLS * cell_px, shift, 0.0)
    level = np.einsum("ki,kij,kj->k", rest, weight, rest) <= allowed
    level &= np.abs(scale - 1.0) * depth_m <= _STEP_M
    bent = (agreement.shift_sigmas * agreement.sigma) ** 2 * count
    step = level & ((scale - 1.0) ** 2 * size > noise + shift + bent)
    result = planes.copy()
    result[small[level]] = scale[level, None] * reference[level]
    aligned = dict(zip(small[level].tolist(), large[level].tolist(), strict=True))
    return result, aligned, list(zip(small[step].tolist(), large[step].tolist(), strict=True))


def bordering(labels: Labels) -> Indices:
    """[K, 2] the pairs of labels in adjoining cells, in both orders."""
    across = np.stack([labels[:, :-1].ravel(), labels[:, 1:].ravel()], axis=1)
    down = np.stack([labels[:-1].ravel(), labels[1:].ravel()], axis=1)
    pairs = np.concatenate([across, down])
    pairs = pairs[(pairs >= 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])]
    base = int(labels.max(initial=0)) + 1
    keys = np.unique(np.concatenate([pairs @ (base, 1), pairs @ (1, base)]))
    return np.stack(np.divmod(keys, base), axis=1).astype(np.intp)


def _choice(
    moments: Floats,
    group: Indices,
    around: Indices,
    is_large: NDArray[np.bool_],
    planes: Floats,
    parent: Indices,
    bonus: float = _LARGE,
) -> Indices:
    """The best group [K] of nodes with moments [K, 11], out of their own [K], those around [4, K] and large ones.

    is_large, planes: [G + 1] of each group, the last one standing for -1. parent: [G + 1] which each one must not join.
    """
    large = np.flatnonzero(is_large)[:, None]
    choices = np.concatenate([group[None], around, np.broadcast_to(large, (len(large), len(group)))])
    cost = _squares(moments, planes[choices])
    cost -= _NEIGHBOUR * (choices[:, None] == around[None]).sum(axis=1) + bonus * is_large[choices]
    cost[(choices < 0) | (choices == parent[group])] = np.inf
    return np.asarray(choices[np.argmin(cost, axis=0), np.arange(len(group))], np.intp)


def _connected(graph: CellGraph, shape: tuple[int, int], group: Indices) -> Indices:
    """The groups [N] numbered anew, each connected part of one for itself; -1 stays."""
    same = graph.edges[(group[graph.edges[:, 0]] == group[graph.edges[:, 1]])]
    links = coo_array((np.ones(len(same)), (same[:, 0], same[:, 1])), shape=(len(group), len(group)))
    part = connected_components(links, directed=False)[1]
    return np.where(group < 0, -1, part)


def group_moments(graph: CellGraph, group: Indices) -> Floats:
    """[G, 11] of the groups 0 .. G - 1, and an empty one after them that stands for -1."""
    count = int(group.max(initial=-1)) + 2
    moments = summed(graph.moments, np.where(group < 0, count - 1, group), count)
    moments[-1] = 0.0
    return moments


def _misfits(graph: CellGraph, planes: Floats) -> Floats:
    """[N] 1/m: mean of measured less predicted inverse depth of each node, for one plane [N, 3] each."""
    n, x, y, w = graph.moments.T[[0, 1, 2, 6]]
    misfits: Floats = (w - planes[:, 0] * n - planes[:, 1] * x - planes[:, 2] * y) / n
    return misfits


def _squares(moments: Floats, planes: Floats) -> Floats:
    """[C, N] sum of squared misfits of nodes with moments [N, 11], in sigmas of their noise, for planes [C, N, 3]."""
    n, x, y, xx, xy, yy, w, xw, yw, ww, noise = np.ascontiguousarray(moments.T)
    a, b, c = np.ascontiguousarray(np.moveaxis(planes, -1, 0))
    squares = ww - 2 * (a * w + b * xw + c * yw) + a * a * n + b * b * xx + c * c * yy
    squares += 2 * (a * b * x + a * c * y + b * c * xy)
    result: Floats = squares * (n / noise)
    return result


def _standing_off(
    misfit: Floats, cell: Indices, shape: tuple[int, int], points: Floats, least_px: float, config: StepSettings
) -> list[NDArray[np.bool_]]:
    """The connected parts of a surface's nodes, as masks [K], that stand off its plane by `misfit` [K], 1/m.

    points: [K] of each node; parts that have fewer than `least_px` may be left out.
    """
    mask, image = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    mask.ravel()[cell], image.ravel()[cell] = 1.0, misfit
    window = (_WINDOW_CELLS, _WINDOW_CELLS)
    mean = (cv2.blur(image, window) / np.maximum(cv2.blur(mask, window), 1e-6)).ravel()[cell]
    limit = config.step_sigmas * _DEVIATION * _median(np.abs(mean))
    parts = []
    for side in (1.0, -1.0):
        off = side * mean > limit
        if points[off].sum() < least_px:
            continue
        height = side * misfit
        for part in _above(limit, side * mean, cell, shape, points, least_px):
            # Means reach beyond the part itself
            parts.append(part & (height > 0.5 * np.quantile(height[part], _TYPICAL)))
    return parts


def _strips(
    misfit: Floats, cell: Indices, shape: tuple[int, int], points: Floats, least_px: float, config: StepSettings
) -> list[NDArray[np.bool_]]:
    """Like `_standing_off`: parts so narrow and far away that only means along them tell them from noise.

    What noise does to a sum along a line is told from all other places in the surface: what neighbours err alike is in
    it.
    """
    row, column = (i - i.min() for i in np.divmod(cell, shape[1]))
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    cell = row * shape[1] + column
    mask, image = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    mask.ravel()[cell], image.ravel()[cell] = 1.0, misfit
    found: list[tuple[float, NDArray[np.bool_]]] = []
    for window in _LINE_WINDOWS:
        cells, sums = (cv2.filter2D(i, -1, window, borderType=cv2.BORDER_CONSTANT).ravel()[cell] for i in (mask, image))
        whole = cells >= 0.5 * float(window.sum())
        sums = np.where(whole, sums / np.sqrt(np.maximum(cells, 1.0)), 0.0)
        sigma = _DEVIATION * _median(np.abs(sums[whole])) if whole.any() else 0.0
        for height in (sums, -sums):
            if height.max() > config.strip_sure_sigmas * sigma:
                parts = _above(config.strip_likely_sigmas * sigma, height, cell, shape, points, least_px)
                found += [(float(height[part].max() / sigma), part) for part in parts]
    chosen: list[NDArray[np.bool_]] = []
    for sigmas, part in sorted(found, key=lambda item: -item[0]):
        if sigmas > config.strip_sure_sigmas and not any((part & other).any() for other in chosen):
            chosen.append(part)
    return chosen


def _median(values: Floats) -> float:
    """Of one value or more, finite; NumPy's own looks for much else, and takes ten times as long on a few hundred."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    middle = np.partition(values, (low, high))
    return float(0.5 * (middle[low] + middle[high]))


def _above(
    limit: float, height: Floats, cell: Indices, shape: tuple[int, int], points: Floats, least_px: float
) -> list[NDArray[np.bool_]]:
    """The connected parts, as masks [K], of the nodes that have more than that height [K], of `least_px` points."""
    image = np.zeros(shape, np.uint8)
    image.ravel()[cell] = height > limit
    number = cv2.connectedComponents(image, connectivity=8)[1].ravel()[cell]
    return [number == index for index in np.flatnonzero(np.bincount(number, points) >= least_px) if index > 0]


def _line_windows() -> list[NDArray[np.float32]]:
    """Lines through the middle of a square of cells, in directions equally far apart."""
    reach = _LINE_CELLS // 2
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    windows = []
    for angle in np.arange(_LINE_DIRECTIONS) * np.pi / _LINE_DIRECTIONS:
        across = np.abs(y * np.cos(angle) - x * np.sin(angle))
        along = np.abs(y * np.sin(angle) + x * np.cos(angle))
        inside = np.clip(0.5 * (_LINE_WIDTH_CELLS + 1) - across, 0.0, 1.0)
        windows.append((inside * np.clip(0.5 * (_LINE_CELLS + 1) - along, 0.0, 1.0)).astype(np.float32))
    return windows


_LINE_WINDOWS = _line_windows()


def _no_parents(group: Indices) -> Indices:
    """[G + 1] for groups none of which was taken out of another one."""
    return np.full(int(group.max(initial=-1)) + 2, -1, np.intp)


def _agree(pair: Floats, agreement: Agreement) -> bool:
    """Whether one plane may serve the two sets with moments [2, 11]."""
    return bool(agreement.admits(Joints.of(pair, np.array([0]), np.array([1])))[0])


def _around(grid: Indices) -> Indices:
    """[4, rows * columns] what stands at the sides of each cell of a grid; -1 beyond the border."""
    padded = np.full((grid.shape[0] + 2, grid.shape[1] + 2), -1)
    padded[1:-1, 1:-1] = grid
    sides = (padded[1:-1, 2:], padded[1:-1, :-2], padded[2:, 1:-1], padded[:-2, 1:-1])
    return np.stack(sides).reshape(len(sides), -1)
