"""Whether places on a plane lie within its outlines, or close to them."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.geometry import tangent_axes
from tgslam.types import Plane

_STEPS = 3  # of the grid in the margin: borders are known to a sixth of it
_MAX_SIDE = 2048  # of the grid, so that it takes 4 MiB at most: larger planes get a coarser one


class Outline:
    """The outlines of a plane and a margin around them, on a grid."""

    def __init__(self, plane: Plane, margin_m: float) -> None:
        """A plane without outlines, as one of a few cells is, has no bounds."""
        self._axes = tangent_axes(plane.normal_w)
        polygons = [polygon @ self._axes.T for polygon in plane.polygons_w]
        self._inside = np.zeros((0, 0), bool)
        if not polygons:
            return
        corners = np.concatenate(polygons)
        self._low = corners.min(axis=0) - 2 * margin_m
        extent = corners.max(axis=0) + 2 * margin_m - self._low
        self._step = max(margin_m / _STEPS, float(extent.max()) / _MAX_SIDE)
        columns, rows = (int(i) for i in np.ceil(extent / self._step) + 1)
        drawn = np.zeros((rows, columns), np.uint8)
        for polygon in polygons:  # one after the other: in one go, where two overlap would be outside
            cv2.fillPoly(drawn, [np.rint((polygon - self._low) / self._step).astype(np.int32)], 1)
        reach = round(margin_m / self._step)
        around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        self._inside = np.pad(cv2.dilate(drawn, around) > 0, 1)  # beyond it is what its border says: outside

    def holds(self, points_w: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which of points [N, 3] m lie over the outlines or within the margin of them."""
        if not self._inside.size:
            return np.ones(len(points_w), bool)
        x, y, z = points_w.T
        column, row = (
            np.rint((x * axis[0] + y * axis[1] + z * axis[2] - low) / self._step + 1.0)
            for axis, low in zip(self._axes, self._low, strict=True)
        )
        rows, columns = self._inside.shape
        held: NDArray[np.bool_] = self._inside[
            np.clip(row, 0, rows - 1).astype(np.intp), np.clip(column, 0, columns - 1).astype(np.intp)
        ]
        return held
