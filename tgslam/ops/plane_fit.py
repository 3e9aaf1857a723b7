"""Operations on depth images that find planes: affine inverse depth over cells of pixels, labels, robust sums.

A plane is [g0, gx, gy] with inverse depth w(u, v) = g0 + gx (u - cx) + gy (v - cy), 1/m and 1/m per px. Moments are
float64 [N, 10]: sums of 1, x, y, xx, xy, yy, w, xw, yw, ww with x = u - cx, y = v - cy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.device import runtime
from tgslam.device.arrays import require
from tgslam.kernels import plane_fit as kernels
from tgslam.kernels.image import SPLIT

Floats = NDArray[np.float64]
Labels = NDArray[np.int32]
Indices = NDArray[np.intp]

FEWEST_PX = 4  # a side of a cell: with fewer, noise hides what shape it has


@dataclass(frozen=True)
class CellGrid:
    """An image cut into square cells, row by row; those at the right and the lower border may be smaller."""

    camera: Camera
    cell_px: int

    @classmethod
    def across(cls, camera: Camera, cells: int) -> CellGrid:
        """The grid of about so many cells in a row, each of `FEWEST_PX` or more a side."""
        return cls(camera, max(round(camera.width / cells), FEWEST_PX))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of cells."""
        return -(-self.camera.height // self.cell_px), -(-self.camera.width // self.cell_px)

    def __len__(self) -> int:
        return self.shape[0] * self.shape[1]

    def centres(self) -> Floats:
        """[C, 2] x, y in px from the principal point, of whole cells."""
        rows, columns = np.divmod(np.arange(len(self)), self.shape[1])
        corner = np.stack([columns, rows], axis=1) * self.cell_px
        return corner + (self.cell_px - 1) / 2 - np.array([self.camera.cx, self.camera.cy])


@dataclass(frozen=True)
class SegmentSums:
    """Sums over the pixels that a plane has in a cell: R rows, one for each plane and cell that share any."""

    plane: Indices  # [R] index
    cell: Indices  # [R] index
    moments: Floats  # [R, 10] robustly weighted; in place of w the misfit, 1/m
    pixels: Floats  # [R]
    squares: Floats  # [R] 1/m^2, sum of squared misfits, not weighted

    def rows(self, chosen: Indices) -> SegmentSums:
        """Some of them."""
        return SegmentSums(
            self.plane[chosen], self.cell[chosen], self.moments[chosen], self.pixels[chosen], self.squares[chosen]
        )


class PixelLabels:
    """Which pixel lies on which plane, and the sums that the planes are fitted anew from."""

    def __init__(self, depth_m: np.ndarray, grid: CellGrid, cell_labels: Labels) -> None:
        """depth_m: device [H, W] m, 0 = none. cell_labels: [rows, columns] plane of each cell, -1 = none."""
        camera = grid.camera
        require("depth_m", depth_m, camera.shape)
        self._inverse = runtime.empty(depth_m.shape)
        kernels.inverse_depth(depth_m, SPLIT, self._inverse)
        self._grid = grid
        self._where = (camera.cx, camera.cy, grid.cell_px, grid.shape[1])
        self._found = runtime.empty((len(grid), kernels.CANDIDATES), np.int32)
        kernels.candidates(runtime.to_device(cell_labels, np.int32), self._found)
        self._labels = runtime.empty(depth_m.shape, np.int32)

    def assign(self, planes: Floats, tolerance: Floats) -> None:
        """Give each pixel one of the planes [P, 3] of its cell and the neighbouring ones, if it fits within tolerance.

        tolerance: [P] 1/m. Where several fit, the 5 x 5 pixels around decide; pixels alone with their label lose it.
        """
        raw = runtime.empty(self._inverse.shape, np.int32)
        kernels.label_pixels(
            self._inverse, *self._where, self._found, runtime.to_device(planes), runtime.to_device(tolerance), raw
        )
        kernels.drop_lonely(raw, SPLIT, self._labels)

    def sums(self, planes: Floats, scale: float) -> SegmentSums:
        """Sums of the misfits to the planes [P, 3], with Charbonnier weights of that scale, 1/m."""
        grid = self._grid
        out = runtime.empty((len(grid), kernels.CANDIDATES, kernels.SEGMENT_SUMS))
        kernels.segment_sums(
            self._inverse, *self._where, self._found, runtime.to_device(planes), self._labels, scale, out
        )
        found, values = runtime.to_host(self._found), runtime.to_host(out)
        values = values.reshape(-1, kernels.SEGMENT_SUMS)
        shared = np.flatnonzero(values[:, kernels.RAW_COUNT] > 0)
        rows, cell = values[shared].astype(np.float64), shared // kernels.CANDIDATES
        moments = moved(rows[:, : kernels.MOMENTS], grid.centres()[cell], np.zeros(len(cell)))
        return SegmentSums(
            found.ravel()[shared].astype(np.intp),
            cell,
            moments,
            rows[:, kernels.RAW_COUNT],
            rows[:, kernels.RAW_SQUARES],
        )

    def read(self) -> Labels:
        """[H, W] on the host, -1 = none."""
        return runtime.to_host(self._labels)


def cell_moments(depth_m: np.ndarray, grid: CellGrid) -> tuple[Floats, Floats]:
    """Moments [C, 10] of each cell's measurements, and the variance of their white noise [C], 1/m^2.

    depth_m: device [H, W] m, 0 = none. The noise is told from 2 x 2 pixels, whose twist no plane has; 0 without any.
    """
    require("depth_m", depth_m, grid.camera.shape)
    moments, reference = runtime.empty((len(grid), kernels.MOMENTS)), runtime.empty((len(grid),))
    twist = runtime.empty((len(grid), 2))
    kernels.cell_moments(depth_m, grid.cell_px, grid.shape[1], moments, reference, twist)
    local, (squares, count) = runtime.to_host(moments).astype(np.float64), runtime.to_host(twist).astype(np.float64).T
    noise = squares / np.maximum(4.0 * count, 1.0)
    return moved(local, grid.centres(), runtime.to_host(reference).astype(np.float64)), noise


def moved(moments: Floats, by: Floats, w0: Floats) -> Floats:
    """Moments [N, 10] of (x + by_x, y + by_y, w + w0) from those of (x, y, w). by: [N, 2]; w0: [N]."""
    n, x, y, xx, xy, yy, w, xw, yw, ww = moments.T
    dx, dy = by.T
    columns = (
        n,
        x + n * dx,
        y + n * dy,
        xx + dx * (2 * x + n * dx),
        xy + dx * y + dy * x + n * dx * dy,
        yy + dy * (2 * y + n * dy),
        w + n * w0,
        xw + dx * w + w0 * (x + n * dx),
        yw + dy * w + w0 * (y + n * dy),
        ww + w0 * (2 * w + n * w0),
    )
    return np.stack(columns, axis=1)
