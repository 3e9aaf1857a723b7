"""How noisy a depth sensor is, learnt from one of its images. NumPy only.

Small windows of the image are smooth surfaces but for edges: what is left of their inverse depth after a fit is noise.
Windows over edges are left far off. So the noise is where most windows lie close together, not their mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import USUAL_NOISE

_WINDOW_PX = 8  # wider than neighbours err alike, narrower than most surfaces
_MOST_WINDOWS = 1200  # of an image, spread evenly
_LEAST_WINDOWS = 30  # fewer say nothing
_LEAST_SHARE = 0.4  # of a window's pixels have depth
_ROWS = 120  # of an image, whose values tell its steps
_KNOTS = 24  # depths at which they are looked for
_SPACING = 0.02  # of a depth: distinct values so near tell the sensor's steps
_TIE = 0.2  # of the logarithm: windows so near to a model speak for it; sqrt(1 / 2n) of n = 58 is 0.09
_LOG_GROWTHS = np.linspace(np.log(1e-6), np.log(1.0), 300)  # of the noise at the median depth, as a part of it
_FLOORS = np.concatenate([[0.0], np.geomspace(0.1, 10.0, 24)])  # over the part that grows, at the median depth
_FLOOR_GAIN = 1.05  # a floor must win so many times the windows that one parameter less does
UNUSUAL = 2.0  # times the usual noise; up to here, it is one sensor's as well as another's
_CUSTOMARY_SCALES = (1000.0, 5000.0)  # units in a metre: millimetres, and those of the TUM benchmark
_REACH = 0.95  # of the measurements are nearer than what counts as how far one sees
_SMALLEST_ROOM_M, _LARGEST_ROOM_M = 1.5, 8.0  # how far one sees in rooms


@dataclass(frozen=True)
class LearntNoise:
    """What one depth image says of its sensor: sigma_z^2 = floor_m^2 + (per_m2 z^2)^2."""

    floor_m: float
    per_m2: float  # 1/m
    step: float  # between neighbouring values of depth, as a part of the depth, at the median
    windows: int  # that it was learnt from

    def sigma_m(self, depth_m: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Standard deviations [...] m of measured depths [...] m."""
        return np.hypot(self.floor_m, self.per_m2 * np.square(depth_m))

    def equivalent_per_m2(self, depth_m: float) -> float:
        """The factor k of sigma_z = k z^2 that is as noisy at a depth, 1/m."""
        return float(self.sigma_m(depth_m) / depth_m**2)


def median_depth_m(depth_m: NDArray[np.float32]) -> float:
    """Of the measurements of an image [H, W] m, 0 = none; 0.0 when there are none."""
    return _quantile_m(depth_m, 0.5)


def reach_m(depth_m: NDArray[np.float32]) -> float:
    """How far one sees in an image [H, W] m, 0 = none: what stands close before the camera does not matter."""
    return _quantile_m(depth_m, _REACH)


def _quantile_m(depth_m: NDArray[np.float32], share: float) -> float:
    sample = depth_m[::4, ::4]
    sample = sample[sample > 0] if (sample > 0).any() else depth_m[depth_m > 0]
    return float(np.quantile(sample, share)) if len(sample) else 0.0


def learn_noise(depth_m: NDArray[np.float32]) -> LearntNoise | None:
    """The noise of the sensor that gave depth [H, W] m, 0 = none; None for an image that says too little."""
    depths, sigmas, steps = _windows(depth_m)
    if len(depths) < _LEAST_WINDOWS:
        return None
    middle = float(np.median(depths))
    floor, growth = _most_common(depths / middle, sigmas * depths**2 / middle)
    step = float(np.median(steps))
    return LearntNoise(floor * middle, growth / middle, step, len(depths))


def _windows(depth_m: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Of windows with enough depth, [N] each: mean depth in m, deviation of inverse depth in 1/m, relative steps."""
    side = _WINDOW_PX
    rows, columns = depth_m.shape[0] // side, depth_m.shape[1] // side
    cut = depth_m[: rows * side, : columns * side].reshape(rows, side, columns, side)
    depth = cut.transpose(0, 2, 1, 3).reshape(rows * columns, side * side)
    depth = depth[(depth > 0).mean(axis=1) >= _LEAST_SHARE].astype(np.float64)
    if not len(depth):
        return np.zeros(0), np.zeros(0), np.zeros(0)
    depth = depth[np.unique(np.linspace(0, len(depth) - 1, _MOST_WINDOWS).astype(int))]
    measured = depth > 0
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=measured)
    middle = measured.sum(axis=1) / inverse.sum(axis=1)
    left = _unexplained(inverse * middle[:, None], measured) / middle
    steps = _steps(depth_m, middle)
    return middle, np.maximum(left, steps / np.sqrt(12.0) / middle), steps


def _unexplained(values: NDArray[np.float64], measured: NDArray[np.bool_]) -> NDArray[np.float64]:
    """[N] standard deviations of values [N, P] about the quadratic surface that fits each row's window best."""
    v, u = (np.mgrid[:_WINDOW_PX, :_WINDOW_PX].reshape(2, -1) + 0.5) / _WINDOW_PX - 0.5
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
    products = (terms[:, :, None] * terms[:, None, :]).reshape(len(terms), -1)
    count = terms.shape[1]
    A = (measured.astype(np.float64) @ products).reshape(-1, count, count) + 1e-9 * np.eye(count)
    fits = np.linalg.solve(A, (values @ terms)[..., None])[..., 0]
    rest = np.where(measured, values - fits @ terms.T, 0.0)
    return np.sqrt((rest**2).sum(axis=1) / (measured.sum(axis=1) - count))


def _steps(depth_m: NDArray[np.float32], at_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N] difference of neighbouring values of depth near each of some depths, as a part of that depth."""
    some = depth_m[:: max(1, depth_m.shape[0] // _ROWS)]
    values = np.unique(some[some > 0]).astype(np.float64)
    if not len(values):
        return np.zeros(len(at_m))
    knots = np.unique(np.quantile(at_m, np.linspace(0.0, 1.0, _KNOTS)))
    ends = np.searchsorted(values, np.outer(knots, (1.0 - _SPACING, 1.0 + _SPACING)))
    apart = [np.diff(values[begin:end]) for begin, end in ends]
    # a lower quantile, since some values in between may be missing
    steps = [np.quantile(gaps, 0.25, method="higher") if len(gaps) else 0.0 for gaps in apart]
    return np.asarray(np.interp(at_m, knots, np.array(steps) / knots))


def _most_common(depths: NDArray[np.float64], sigmas: NDArray[np.float64]) -> tuple[float, float]:
    """Floor and growth of the model that most windows [N] agree with, everything in units of the median depth."""
    found = np.log(np.maximum(sigmas, 1e-9))
    # whatever the floor's share of the noise at the median depth, a window's own deviation says what the growth is
    votes = np.stack([_votes(found - 0.5 * np.log(share**2 + depths**4)) for share in _FLOORS])
    row = int(votes.max(axis=1).argmax()) if votes.max() > _FLOOR_GAIN * votes[0].max() else 0
    growth = float(np.exp(_LOG_GROWTHS[votes[row].argmax()]))
    return float(_FLOORS[row]) * growth, growth


def _votes(logs: NDArray[np.float64]) -> NDArray[np.float64]:
    """How many of `logs` [N] lie near the logarithm of each growth."""
    width = _LOG_GROWTHS[1] - _LOG_GROWTHS[0]
    counts = np.histogram(logs, bins=np.append(_LOG_GROWTHS - width / 2, _LOG_GROWTHS[-1] + width / 2))[0]
    reach = np.arange(-3.0 * _TIE, 3.0 * _TIE, width)
    kernel = np.exp(-0.5 * ((reach - reach.mean()) / _TIE) ** 2)
    return np.asarray(np.convolve(counts, kernel, mode="same"))


def unit_of(reach: float) -> float:
    """The unit of length, m, in which a world where one sees so far, m, is as large as a room.

    A power of two: 1 unless all that is seen is near, or most of it far.
    """
    if reach <= 0.0:
        return 1.0
    inside = min(max(reach, _SMALLEST_ROOM_M), _LARGEST_ROOM_M)
    return float(2.0 ** np.round(np.log2(reach / inside)))


def likelier_scale(depth_scale: float, per_m2: float, reach: float) -> float | None:
    """Another customary scale of depth images that makes both the sensor and the world usual, where this one does not.

    depth_scale: units in a metre, as depth was read. per_m2: noise of sigma_z = per_m2 z^2, 1/m, and how far one sees,
    m, as they come out by it. Depth alone never tells its scale; noise and size together do, for those who guess.
    """

    def usual(factor: float) -> bool:
        """Whether lengths that are so many times as large would be."""
        noise = per_m2 / factor / USUAL_NOISE.per_m2
        return _SMALLEST_ROOM_M < factor * reach < _LARGEST_ROOM_M and 1.0 / UNUSUAL < noise < UNUSUAL

    if depth_scale not in _CUSTOMARY_SCALES or usual(1.0):
        return None
    noise = per_m2 / USUAL_NOISE.per_m2
    for other in _CUSTOMARY_SCALES:
        factor = depth_scale / other
        # both must be off, and in the same sense
        off = noise > UNUSUAL and reach < _SMALLEST_ROOM_M if factor > 1.0 else reach > _LARGEST_ROOM_M
        if other != depth_scale and off and usual(factor):
            return other
    return None
