"""Instances that are a larger one's unevenness: a panel that buckles stands off its own plane in the middle."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.config.plane_settings import SegmentationSettings
from tgslam.planes.instances.instance import NO_ID, PlanarInstance

_LARGER = 4.0  # times as large as its part is a surface
_LEAST_COSINE = float(np.cos(0.05))  # of the angle by which sensor and surface may turn a small fit
_MOST_CELLS = 0.9  # of a part, that stand off no more than surfaces stray from planes
_SURROUNDED = 0.65  # share of the cells around a part that are the larger surface: border strips have half of them
_AROUND_CELLS = 2  # away is what surrounds a part: borders are known to a cell


def is_part(small: PlanarInstance, large: PlanarInstance, config: SegmentationSettings) -> bool:
    """Whether an instance is but an unevenness of another one, which surrounds it and off which it hardly stands.

    By how much surfaces stray from their planes is `join_shift_m`. What is fixed to a wall may be no thicker than that;
    most of it, skirting boards and door frames, ends where the wall does.
    """
    if large.id == NO_ID or small is large or small.normal_w @ large.normal_w < _LEAST_COSINE:
        return False
    if len(small.support) * _LARGER > len(large.support):  # counts cells: for the few that are parallel only
        return False
    cells, _ = small.support.cells()
    centres = small.support.centres(cells)
    if not len(cells) or np.mean(np.abs(large.plane.heights_m(centres)) < config.join_shift_m) < _MOST_CELLS:
        return False
    around = _around(large.support.cells_of(centres))
    return float(np.mean(large.support.holds(around))) >= _SURROUNDED


def _around(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """The cells [M, 2] next to any of cells [N, 2], of whatever is no gap between these."""
    low = cells.min(axis=0) - _AROUND_CELLS - 1
    mask = np.zeros(cells.max(axis=0) - low + _AROUND_CELLS + 2, np.uint8)
    mask[tuple((cells - low).T)] = 1
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    size = 2 * _AROUND_CELLS + 1
    grown = cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
    return np.argwhere((grown > 0) & (mask == 0)) + low
