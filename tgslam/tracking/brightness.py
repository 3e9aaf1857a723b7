"""Exposures of keyframes, from the surfaces that several of them see. The paper takes them as constant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import spsolve

from tgslam.camera import Camera
from tgslam.geometry import inverse, transform_points
from tgslam.map.keyframes import Keyframe
from tgslam.tracking.references import references_of
from tgslam.types import Exposure

# A keyframe is compared with those so many before: the near ones show the same best, and with far ones nothing adds up
_BACK = (1, 2, 4, 8, 16, 32)
_ALIKE = 3  # and with so many of the oldest that show the same: where a camera returns, the gains agree
_STEP_PX = 4  # every n-th pixel and row
_SAME_SURFACE = 0.03  # relative difference of depth
_MIN_PIXELS = 200
_CLIPPED = 0.03, 0.97  # intensities beyond are cut off, or nearly
# Of the ratio of two views' intensities, whatever the number of pixels: vignetting, highlights, surfaces that are not
# Lambertian. What two surfaces in one view differ by says more, where it is more.
_SYSTEMATIC = 0.03
_SPREAD = 1.48  # standard deviation by median absolute deviation, of a normal distribution
# Steps of the log gain from one keyframe to the next that are much smaller count as none. Beyond, the prior is flat: it
# does not shrink what the views agree on, and any step costs as much.
_NO_STEP = 0.005
_STEP_COST = 0.5  # negative log likelihood
_TRACKED = 0.05  # of the gain that the tracker had against the map, for a keyframe that shares no surface with others
_WINDOW = 100  # latest keyframes whose gains are still open; those of earlier ones have settled
_ROUNDS = 20  # of reweighting
_CONVERGED = 1e-5


class Ratio(NamedTuple):
    """What two keyframes' images say of their gains: that of the first over that of the second one."""

    log_gain: float
    sigma: float


class Tie(NamedTuple):
    """A measured difference of log gains, that of `keyframe` less that of `other`; -1 is the map, whose gain is 1."""

    keyframe: int
    other: int
    log_gain: float
    sigma: float


class KeyframeExposures:
    """Gains of all keyframes at once: chained from each to the next, small errors would add up without end.

    The map cannot tell so well: from nearer than it was refined from, it looks a little darker, since the low-pass
    filter of splats widens them less.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._ties: list[Tie] = []

    def add(self, keyframes: Sequence[Keyframe]) -> None:
        """Measure the latest keyframe, whose exposure is as tracked, and set anew those of all that it bears on."""
        latest = len(keyframes) - 1
        if latest == 0:
            return
        log_gains = np.log([keyframe.exposure.gain for keyframe in keyframes])
        found = [
            Tie(latest, other, *ratio)
            for other in self._partners(keyframes)
            if (ratio := gain_ratio(keyframes[latest], keyframes[other], self._camera))
        ]
        if found:
            log_gains[latest] = log_gains[found[0].other] + found[0].log_gain
        else:
            found = [Tie(latest, -1, float(log_gains[latest]), _TRACKED)]
        first = max(len(keyframes) - _WINDOW, 1)  # the very first keyframe is what the map is as bright as
        self._ties = [tie for tie in self._ties if tie.keyframe >= first] + found
        for keyframe, log_gain in zip(keyframes[first:], solve(self._ties, log_gains, first), strict=True):
            keyframe.expose(Exposure(float(np.exp(log_gain))))

    def _partners(self, keyframes: Sequence[Keyframe]) -> list[int]:
        """The nearest one first."""
        latest = len(keyframes) - 1
        depth_m = keyframes[latest].depth_m()
        median_m = float(np.median(depth_m[depth_m > 0])) if depth_m.any() else 0.0
        T_cw = np.array([keyframe.T_cw for keyframe in keyframes])
        alike = references_of(T_cw, median_m, 1 + _ALIKE)[1:]
        return sorted({latest - back for back in _BACK if back <= latest} | set(alike), reverse=True)


def gain_ratio(keyframe: Keyframe, other: Keyframe, camera: Camera) -> Ratio | None:
    """What to multiply a keyframe's intensities by to have the other's; None: too little to tell.

    It is the median over the pixels of surfaces that both see: a highlight that moves along does not count.
    """
    rows, columns = np.mgrid[_STEP_PX // 2 : camera.height : _STEP_PX, _STEP_PX // 2 : camera.width : _STEP_PX]
    colour, z = keyframe.pixels(rows, columns)
    x = transform_points(other.T_cw @ inverse(keyframe.T_cw), camera.points_at(columns, rows, z).reshape(-1, 3))
    u, v = (np.rint(place).astype(int) for place in camera.project(x))
    inside = (z.ravel() > 0) & (x[:, 2] > 0) & camera.holds(u, v)
    other_colour, other_z = other.pixels(v[inside], u[inside])
    ahead = np.maximum(x[inside, 2], 1e-3)
    same = np.abs(other_z - ahead) < _SAME_SURFACE * ahead
    here, there = colour.reshape(-1, 3)[inside][same].mean(axis=-1), other_colour[same].mean(axis=-1)
    sound = (np.minimum(here, there) > _CLIPPED[0]) & (np.maximum(here, there) < _CLIPPED[1])
    if sound.sum() < _MIN_PIXELS:
        return None
    log_ratios = np.log(there[sound] / here[sound])
    median = float(np.median(log_ratios))
    return Ratio(median, max(_SYSTEMATIC, _SPREAD * float(np.median(np.abs(log_ratios - median)))))


def solve(ties: Sequence[Tie], log_gains: NDArray[np.float64], first: int) -> NDArray[np.float64]:
    """The most likely log gains near those [K], from number `first` on; by iteratively reweighted least squares.

    The errors of ties have a Cauchy distribution, so that wrong ties do not count. Steps between keyframes are none or
    free (the Geman-McClure function).
    """
    columns, steps = np.array(ties, np.float64).T, np.arange(first, len(log_gains))
    k, other = (np.concatenate([columns[i].astype(int), at]) for i, at in ((0, steps), (1, steps - 1)))
    measured, sigma = (np.append(columns[i], np.full(len(steps), x)) for i, x in ((2, 0.0), (3, _NO_STEP)))
    gains = np.append(log_gains, 0.0)  # at -1 that of the map
    signs = np.concatenate([np.ones(len(k)), -np.ones(len(k))])
    ends, rows = np.concatenate([k, other]) - first, np.tile(np.arange(len(k)), 2)
    free = ends >= 0
    differences = csr_matrix((signs[free], (rows[free], ends[free])), shape=(len(k), len(steps)))
    for _ in range(_ROUNDS):
        error = measured - (gains[k] - gains[other])
        weight = 1.0 / (sigma**2 + error**2)
        weight[-len(steps) :] = 2.0 * _STEP_COST * (_NO_STEP * weight[-len(steps) :]) ** 2
        weighted = differences.T.multiply(weight).tocsc()
        change = spsolve((weighted @ differences).tocsc(), weighted @ error)
        gains[first:-1] += change
        if np.abs(change).max() < _CONVERGED:
            break
    return gains[first:-1]
