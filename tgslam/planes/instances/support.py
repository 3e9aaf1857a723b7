"""Where on its plane a PGI has been seen: a grid of cells with evidence, and the polygons of its extent."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.planes.estimate import PlaneEstimate

Vector = NDArray[np.float64]
Cells = NDArray[np.int64]

_MAX_EVIDENCE = 20  # so that what has moved away can be forgotten in reasonable time
_MAX_SIDE = 1024  # cells; a larger grid gets cells twice the size
_OUTLINE_SCALE = 2  # outlines are traced at this many pixels a cell
_MIN_OUTLINE_CELLS = 4  # of a part with an outline: smaller ones are mostly noise of a border


class Support:
    """A grid on a plane. A cell counts as part of the surface while its evidence is positive.

    Each cell knows the keyframe that saw it first: when that keyframe is moved, the cell moves with it.
    """

    def __init__(self, plane: PlaneEstimate, cell_m: float) -> None:
        """Empty, with its origin at the plane's centroid."""
        self.cell_m = cell_m
        self.origin: Vector = plane.centroid.copy()  # [3] m, world
        self.axes: Vector = plane.axes.copy()  # [2, 3] unit, right-handed with the normal
        self._low: Cells = np.zeros(2, np.int64)  # cell of the arrays' first element
        self._evidence = np.zeros((0, 0), np.uint8)
        self._keyframe = np.zeros((0, 0), np.int32)

    def __len__(self) -> int:
        return int(np.count_nonzero(self._evidence))

    @property
    def area_m2(self) -> float:
        """Of the occupied cells."""
        return len(self) * self.cell_m**2

    def cells_of(self, points_w: Vector) -> Cells:
        """The cells [N, 2] over which points [N, 3] m lie."""
        return np.floor((points_w - self.origin) @ self.axes.T / self.cell_m).astype(np.int64)

    def shows_extent(self, points: Vector, T_wc: Vector) -> NDArray[np.bool_]:
        """Which of points [3, N] m, in the frame of T_wc [4, 4], lie over occupied cells."""
        along = self.axes / self.cell_m
        low = along @ (T_wc[:3, 3] - self.origin) - self._low
        places = [
            np.floor(a * points[0] + b * points[1] + c * points[2] + d).astype(np.intp)
            for (a, b, c), d in zip(along @ T_wc[:3, :3], low, strict=True)
        ]
        return _lookup(self._evidence, *places)

    def centres(self, cells: Cells) -> Vector:
        """Their middles [N, 3] m, world."""
        return self.origin + (cells + 0.5) * self.cell_m @ self.axes

    def cells(self) -> tuple[Cells, NDArray[np.int32]]:
        """The occupied cells [N, 2] and the keyframe [N] that saw each first."""
        rows, columns = np.nonzero(self._evidence)
        return np.column_stack([rows, columns]) + self._low, self._keyframe[rows, columns]

    def corners(self) -> Vector:
        """[4, 3] m, world: of the rectangle that holds everything."""
        unit = np.array([[0, 0], [0, 1], [1, 1], [1, 0]])
        return self.origin + (self._low + unit * self._evidence.shape) * self.cell_m @ self.axes

    def holds(self, cells: Cells) -> NDArray[np.bool_]:
        """Which of the cells [N, 2] are occupied."""
        return _lookup(self._evidence, *(cells - self._low).T)

    def near(self, cells: Cells, gap_m: float) -> NDArray[np.bool_]:
        """Which of the cells [N, 2] lie within a gap of an occupied one."""
        reach = 1 + int(gap_m / self.cell_m)  # neighbours stand one cell apart and have no gap between them
        padded = np.pad((self._evidence > 0).astype(np.uint8), reach)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        return _lookup(cv2.dilate(padded, kernel) if padded.size else padded, *(cells - self._low + reach).T)

    def connects(self, cells: Cells, others: Cells) -> bool:
        """Whether occupied cells lead from one of the cells [N, 2] to one of the others, side by side."""
        return bool(np.intersect1d(self._parts(cells), self._parts(others)).size)

    def take_part(self, cells: Cells, kept: Cells) -> tuple[Vector, NDArray[np.int32]]:
        """Give away the connected parts to which cells [N, 2] belong, but for those that hold a kept cell [M, 2].

        Returns with the places [K, 3] m, world, and the keyframes [K] that saw them first.
        """
        parts = np.setdiff1d(self._parts(cells), self._parts(kept))
        taken = np.isin(self._components(), parts)
        rows, columns = np.nonzero(taken)
        places, keyframes = self.centres(np.column_stack([rows, columns]) + self._low), self._keyframe[rows, columns]
        self._evidence[taken] = 0
        return places, keyframes

    def _components(self) -> NDArray[np.int32]:
        """The connected part of each cell of the arrays, from 1; 0 = not occupied."""
        if not self._evidence.size:
            return np.zeros(self._evidence.shape, np.int32)
        occupied = (self._evidence > 0).astype(np.uint8)
        return np.asarray(cv2.connectedComponents(occupied, connectivity=4)[1], np.int32)

    def _parts(self, cells: Cells) -> NDArray[np.int32]:
        """The connected parts that these cells [N, 2] belong to."""
        inside = cells[self.holds(cells)] - self._low
        return np.unique(self._components()[inside[:, 0], inside[:, 1]])

    def add(self, cells: Cells, keyframe: int | NDArray[np.int32], evidence: int = 1) -> None:
        """One view's evidence for cells [N, 2], each listed once, seen from `keyframe` (one, or one a cell)."""
        if len(cells) == 0:
            return
        self._cover(cells.min(axis=0), cells.max(axis=0) + 1)
        rows, columns = (cells - self._low).T
        before = self._evidence[rows, columns]
        self._keyframe[rows, columns] = np.where(before > 0, self._keyframe[rows, columns], keyframe)
        self._evidence[rows, columns] = np.minimum(before + evidence, _MAX_EVIDENCE).astype(np.uint8)
        if max(self._evidence.shape) > _MAX_SIDE:
            self._coarsen()

    def weaken(self, cells: Cells) -> None:
        """One view's evidence against cells [N, 2], each listed once."""
        rows, columns = (cells[self.holds(cells)] - self._low).T
        self._evidence[rows, columns] -= 1

    def remove(self, cells: Cells) -> int:
        """Cells [N, 2] are no part of the surface; how many of them were."""
        rows, columns = (cells[self.holds(cells)] - self._low).T
        self._evidence[rows, columns] = 0
        return len(rows)

    def follow(self, plane: PlaneEstimate) -> None:
        """Lay the grid onto the plane as it is estimated now, turned no more than needed."""
        self.origin = self.origin - plane.heights_m(self.origin) * plane.normal
        first = self.axes[0] - (self.axes[0] @ plane.normal) * plane.normal
        first = first / np.linalg.norm(first)
        self.axes = np.stack([first, np.cross(plane.normal, first)])

    def absorb(self, points_w: Vector, keyframes: NDArray[np.int32]) -> None:
        """Add the places [N, 3] of another grid, with the keyframes [N] that saw them first."""
        cells, first = np.unique(self.cells_of(points_w), axis=0, return_index=True)
        self.add(cells, keyframes[first])

    def polygons(self) -> list[Vector]:
        """Outlines [K, 3] m, world, of the connected parts, largest first, counter-clockwise seen from the front.

        Holes are ignored, gaps of one cell closed, and corners simplified to half a cell.
        """
        scale, pad = _OUTLINE_SCALE, 2
        mask = np.pad((self._evidence > 0).astype(np.uint8), pad)
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        fine = np.kron(mask, np.ones((scale, scale), np.uint8))
        contours = cv2.findContours(fine, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
        contours = [c for c in contours if cv2.contourArea(c) >= _MIN_OUTLINE_CELLS * scale**2]
        contours.sort(key=cv2.contourArea, reverse=True)
        return [self._outline(_simplified(c, scale / 2)[:, 0, ::-1], pad) for c in contours]

    def _outline(self, pixels: NDArray[np.int32], pad: int) -> Vector:
        """Pixels [K, 2] (row, column) of the fine mask as points [K, 3]: rows go along the first axis."""
        along = (pixels + 0.5) / _OUTLINE_SCALE - pad + self._low
        doubled_area = np.sum(along[:, 0] * np.roll(along[:, 1], -1) - along[:, 1] * np.roll(along[:, 0], -1))
        return self.origin + (along if doubled_area > 0 else along[::-1]) * self.cell_m @ self.axes

    def _cover(self, low: Cells, high: Cells) -> None:
        """Make the arrays reach from cell `low` to below cell `high`."""
        if self._evidence.size == 0:
            self._low = low.copy()
        before = np.maximum(self._low - low, 0)
        after = np.maximum(high - self._low - self._evidence.shape, 0)
        if before.any() or after.any():
            widths = list(zip(before, after, strict=True))
            self._evidence, self._keyframe = np.pad(self._evidence, widths), np.pad(self._keyframe, widths)
            self._low = self._low - before

    def _coarsen(self) -> None:
        """Cells of twice the size: the memory of a PGI is bounded however large it is."""
        cells, keyframes = self.cells()
        evidence = self._evidence[tuple((cells - self._low).T)]
        self.cell_m *= 2
        self._evidence, self._keyframe = np.zeros((0, 0), np.uint8), np.zeros((0, 0), np.int32)
        coarse, first = np.unique(cells // 2, axis=0, return_index=True)
        self._cover(coarse.min(axis=0), coarse.max(axis=0) + 1)
        rows, columns = (coarse - self._low).T
        self._evidence[rows, columns], self._keyframe[rows, columns] = evidence[first], keyframes[first]


def _simplified(contour: NDArray[np.int32], tolerance: float) -> NDArray[np.int32]:
    """A contour [K, 1, 2] with fewer corners, or as it is where only a line would be left: a row of single cells."""
    simple = np.asarray(cv2.approxPolyDP(contour, tolerance, True), np.int32)
    return simple if len(simple) > 2 else contour


def _lookup(grid: NDArray[np.uint8], row: NDArray[np.int64], column: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Where grid[row, column] > 0, [N] each; False outside the grid."""
    if grid.size == 0:
        return np.zeros(len(row), bool)
    inside: NDArray[np.bool_] = (row >= 0) & (row < grid.shape[0]) & (column >= 0) & (column < grid.shape[1])
    return inside & (grid.ravel()[np.where(inside, row * grid.shape[1] + column, 0)] > 0)
