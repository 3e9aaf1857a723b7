"""Gaps between parts of one plane: where they are narrowest, and what a keyframe shows there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tgslam.config.plane_settings import GapSettings
from tgslam.geometry import inverse, transform_points
from tgslam.planes.estimate import PlaneEstimate
from tgslam.planes.instances.sight import Samples, Tolerance
from tgslam.planes.instances.support import Cells, Support

Vector = NDArray[np.float64]

_CONTACT_CELLS = 3  # in which two surfaces must adjoin: fewer are noise of their borders
_GAP_RATIO = 2.0  # the longest gap in sizes of the smaller surface
_GAP_SLACK_CELLS = 2.0  # wider than at its narrowest place, a gap is not looked at
_TOUCHING_CELLS = 1.5  # apart, cells are neighbours: then only those that touch say whether there is a gap
_GAP_PLACES = 12  # at which a gap is looked at
_STEP_M = 0.01  # between the places along a way through a gap that are looked at
_LEAST_THROUGH, _THROUGH_SHARE = 3, 0.1  # of the places on a way: fewer that are seen through are noise
_FILLED_SHARE = 0.5  # of the places in a gap that do not show the plane, that something close before it shows


@dataclass(frozen=True)
class Gap:
    """What a keyframe shows of the ways between two parts of a plane."""

    open: bool  # one of them is seen through: the parts are two surfaces, or one with a hole
    hidden: bool  # all of them are in the image and none is seen through: the plane may go on behind something else
    filled: bool  # most of what is seen there stands close before the plane, as a board between two fronts does

    def parts(self, larger_m2: float, config: GapSettings) -> bool:
        """Whether it parts two surfaces, of which the larger one has such an area: what fills it hides which they are,
        and small things that happen to be level are as likely as one behind a board.
        """
        return self.open or (self.filled and larger_m2 < config.across_area_m2)


def gap_between(
    samples: Samples, ways: tuple[Vector, Vector], plane: PlaneEstimate, tolerance: Tolerance, close_m: float
) -> Gap:
    """Look at straight ways in a plane, from places [K, 3] m to others [K, 3] m. close_m: what counts as close."""
    starts_w, ends_w = ways
    longest_m = float(np.linalg.norm(ends_w - starts_w, axis=1).max())
    steps = max(int(longest_m / _STEP_M), 3)
    share = np.linspace(0.0, 1.0, steps + 2)[1:-1, None, None]
    places = starts_w + share * (ends_w - starts_w)  # [steps, K, 3]
    u, v, inside = samples.pixels(places.reshape(-1, 3))
    z = np.where(inside, samples.depth_m[v, u], 0.0).astype(np.float64)
    points = samples.camera.points_at(u, v, z)
    height = plane.heights_m(transform_points(inverse(samples.T_cw), points))
    limit = tolerance.sigmas * np.hypot(tolerance.noise.sigma_m(z), tolerance.pose_m)
    through = ((z > 0) & (height < -limit)).reshape(steps, -1).sum(axis=0)
    seen = inside.reshape(steps, -1).sum(axis=0)
    opened = bool(np.any(through >= np.maximum(_LEAST_THROUGH, _THROUGH_SHARE * seen)))
    # The ends of the ways show the parts themselves
    between = (z > 0) & (np.abs(height) > limit)
    close = between & (height > 0) & (height < close_m)
    return Gap(opened, bool(inside.all()) and not opened, bool(close.sum() > _FILLED_SHARE * between.sum()))


def adjoins(beside: NDArray[np.bool_]) -> bool:
    """Whether a surface adjoins another, given which of its cells [N] lie beside cells of that."""
    return int(beside.sum()) >= min(_CONTACT_CELLS, len(beside)) > 0


def shortest_gap(support: Support, cells: Cells, longest_m: float) -> tuple[Vector, Vector] | None:
    """`narrowest` between an extent and cells [N, 2] of its grid; None where even that is wider than longest_m or, if
    longest_m is finite, than twice the size of the smaller of the two.
    """
    occupied, _ = support.cells()
    gap = narrowest(support, cells, occupied)
    if gap is None or not np.isfinite(longest_m):
        return gap
    limit_m = min(longest_m, _GAP_RATIO * support.cell_m * np.sqrt(min(len(occupied), len(cells))))
    return gap if np.linalg.norm(gap[1] - gap[0], axis=1).min() <= limit_m + 1e-9 else None


def narrowest(support: Support, cells: Cells, others: Cells) -> tuple[Vector, Vector] | None:
    """Places [K, 3] m of cells [N, 2] of a grid, and those [K, 3] of other cells, between which the gap is narrowest: a
    few, from all along it. None without cells.
    """
    if len(others) == 0 or len(cells) == 0:
        return None
    distance, nearest = cKDTree(others).query(cells)
    least = float(distance.min())
    slack = _GAP_SLACK_CELLS if least > _TOUCHING_CELLS else 0.0
    narrow = np.flatnonzero(distance <= least + slack)
    chosen = narrow[np.linspace(0, len(narrow) - 1, min(len(narrow), _GAP_PLACES)).astype(int)]
    return support.centres(cells[chosen]), support.centres(others[nearest[chosen]])
