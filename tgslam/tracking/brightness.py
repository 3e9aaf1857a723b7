"""Exposures of keyframes, from the surfaces that several of them see. The paper takes them as constant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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


_TINGE = 0.02  # log of a channel's gain less that of the intensity, from which on channels have gains of their own


class Ratio(NamedTuple):
    """What two keyframes' images say of their gains: that of the first over that of the second one."""

    log_gain: float
    sigma: float
    log_balance: NDArray[np.float64]  # [3] log gain of each channel, less that of the intensity


class _OpenCourse:
    """A log gain of all keyframes, of which those of the latest ones are still open."""

    def __init__(self) -> None:
        self._ties: list[Tie] = []
        self._moves: list[bool] = []  # of each keyframe, whether its gain differs from that of the one before
        self._nearest: list[float] = []  # of each, its log gain less that of the one before, as measured between them

    def first(self, latest: int) -> int:
        """The first keyframe that is open: at least 1, since the very first one is what the map is as bright as."""
        return latest + 1 - len(self._moves)

    def take(self, log_gains: NDArray[np.float64], found: Sequence[Tie]) -> None:
        """The ties of the latest keyframe, the nearest one first. log_gains: [K] of all, as known before."""
        latest, nearest = len(log_gains) - 1, found[0]
        measured = nearest.log_gain + (log_gains[nearest.other] if nearest.other != MAP else 0.0)
        self._nearest = [*self._nearest, float(measured - log_gains[latest - 1])][-_WINDOW:]
        self._moves = [*self._moves, False][-_WINDOW:]
        self._ties = [tie for tie in self._ties if tie.keyframe >= self.first(latest)] + list(found)

    def solve(self, log_gains: NDArray[np.float64]) -> NDArray[np.float64]:
        """[K] of all, from those before."""
        first = self.first(len(log_gains) - 1)
        course = Course(log_gains[first:], np.array(self._moves))
        best = Courses(self._ties, log_gains[:first]).best(course, np.array(self._nearest))
        self._moves = best.moves.tolist()
        return np.concatenate([log_gains[:first], best.log_gains])

    def follow(self, other: _OpenCourse) -> None:
        """Its gains are the other's."""
        self._moves = list(other._moves)


class KeyframeExposures:
    """Gains of all keyframes at once: chained from each to the next, small errors would add up without end.

    The map cannot tell so well: from nearer than it was refined from, it looks a little darker, since the low-pass
    filter of splats widens them less.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._intensity, self._channels = _OpenCourse(), [_OpenCourse() for _ in range(3)]

    def add(self, keyframes: Sequence[Keyframe]) -> None:
        """Measure the latest keyframe, whose exposure is as tracked, and set anew those of all that it bears on."""
        latest = len(keyframes) - 1
        if latest == 0:
            return
        found = {
            other: ratio
            for other in self._partners(keyframes)
            if (ratio := gain_ratio(keyframes[latest], keyframes[other], self._camera))
        }
        log_gains = np.log([keyframe.exposure.gain for keyframe in keyframes])
        log_balances = np.log([keyframe.exposure.balance for keyframe in keyframes])
        by_channel = log_gains[:, None] + log_balances
        first = max(latest + 1 - _WINDOW, 1)
        tinge = [ratio.log_balance + log_balances[other] for other, ratio in found.items()]
        tinged = (bool(tinge) and np.abs(np.median(tinge, axis=0)).max() > _TINGE) or log_balances[first - 1 :].any()
        self._intensity.take(log_gains, _ties(latest, found, None, log_gains[latest]))
        log_gains = self._intensity.solve(log_gains)
        for c, course in enumerate(self._channels):
            course.take(by_channel[:, c], _ties(latest, found, c, by_channel[latest, c]))
            if tinged:
                by_channel[:, c] = course.solve(by_channel[:, c])
            else:
                course.follow(self._intensity)
        log_balances = by_channel - log_gains[:, None] if tinged else np.zeros_like(by_channel)
        for number in range(first, latest + 1):
            r, g, b = np.exp(log_balances[number]).tolist()
            keyframes[number].expose(Exposure(float(np.exp(log_gains[number])), balance=(r, g, b)))

    def _partners(self, keyframes: Sequence[Keyframe]) -> list[int]:
        """The nearest one first."""
        latest = len(keyframes) - 1
        depth_m = keyframes[latest].depth_m()
        median_m = float(np.median(depth_m[depth_m > 0])) if depth_m.any() else 0.0
        T_cw = np.array([keyframe.T_cw for keyframe in keyframes])
        alike = references_of(T_cw, median_m, 1 + _ALIKE)[1:]
        return sorted({latest - back for back in _BACK if back <= latest} | set(alike), reverse=True)


def _ties(latest: int, found: Mapping[int, Ratio], channel: int | None, tracked: float) -> list[Tie]:
    """Of the latest keyframe's intensity or of a channel, to the keyframes that it shares surfaces with.

    tracked: its log gain against the map, which counts where it shares none.
    """
    return [
        Tie(
            latest, other, ratio.log_gain + (0.0 if channel is None else float(ratio.log_balance[channel])), ratio.sigma
        )
        for other, ratio in found.items()
    ] or [Tie(latest, MAP, float(tracked), _TRACKED)]


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
    here, there = colour.reshape(-1, 3)[inside][same], other_colour[same]
    sound = _sound(here.mean(axis=-1), there.mean(axis=-1))
    if sound.sum() < _MIN_PIXELS:
        return None
    log_ratios = np.log(there[sound].mean(axis=-1) / here[sound].mean(axis=-1))
    median = float(np.median(log_ratios))
    sigma = max(_SYSTEMATIC, _SPREAD * float(np.median(np.abs(log_ratios - median))))
    return Ratio(median, sigma, _log_balance(here, there, median))


def _log_balance(here: NDArray[np.float32], there: NDArray[np.float32], log_gain: float) -> NDArray[np.float64]:
    """[3] log gain of each channel of colours [N, 3], less that of the intensity; 0 where there is too little to tell.

    What is clipped in one channel is not sound in it, whatever the others say.
    """
    sound = _sound(here, there).all(axis=-1)
    if sound.sum() < _MIN_PIXELS:
        return np.zeros(3)
    return np.median(np.log(there[sound] / here[sound]), axis=0).astype(np.float64) - log_gain


def _sound(here: NDArray[np.float32], there: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether intensities, or those of channels, are in neither image cut off or nearly so."""
    return (np.minimum(here, there) > _CLIPPED[0]) & (np.maximum(here, there) < _CLIPPED[1])
