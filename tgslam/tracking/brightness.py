"""Exposures of keyframes, from the surfaces that several of them see. The paper takes them as constant."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tgslam.camera import Camera
from tgslam.geometry import inverse, transform_points
from tgslam.map.keyframes import Keyframe
from tgslam.tracking.exposure_steps import MAP, Course, Courses, Tie
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
_TRACKED = 0.05  # of the gain that the tracker had against the map, for a keyframe that shares no surface with others
_WINDOW = 100  # latest keyframes whose gains are still open; those of earlier ones have settled


class Ratio(NamedTuple):
    """What two keyframes' images say of their gains: that of the first over that of the second one."""

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
        self._moves: list[bool] = []  # of each keyframe, whether its exposure differs from that of the one before
        self._nearest: list[float] = []  # of each, its log gain less that of the one before, as measured between them

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
        ] or [Tie(latest, MAP, float(log_gains[latest]), _TRACKED)]
        nearest = found[0].log_gain + (log_gains[found[0].other] if found[0].other != MAP else 0.0)
        self._nearest = [*self._nearest, nearest - log_gains[latest - 1]][-_WINDOW:]
        self._moves = [*self._moves, False][-_WINDOW:]
        first = latest + 1 - len(self._moves)  # at least 1: the very first keyframe is what the map is as bright as
        self._ties = [tie for tie in self._ties if tie.keyframe >= first] + found
        course = Course(log_gains[first:], np.array(self._moves))
        best = Courses(self._ties, log_gains[:first]).best(course, np.array(self._nearest))
        self._moves = best.moves.tolist()
        for keyframe, log_gain in zip(keyframes[first:], best.log_gains, strict=True):
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
