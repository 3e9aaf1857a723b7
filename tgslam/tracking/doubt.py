"""When to look for another place than the one that a frame has been aligned at."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.geometry import inverse, se3_log
from tgslam.tracking.result import TrackingResult

_HISTORY = 30  # tracked frames whose misfit says what is usual here: a second
_MIN_HISTORY = 3  # of them, for their median to say anything
_UNUSUAL = 1.5  # times the usual misfit
_MEMORY = 0.8  # of how far predictions were off, from a frame to the next
_CONVINCING = 0.5  # of a frame's pixels agree with the map, where nothing else says that the camera is there
_UNMATCHED = 3.0  # standard deviations that a pixel is taken to be off whose depth does not match at all


def misfit(result: TrackingResult) -> float:
    """By how much what meets the map is off on average, depth and colour, in standard deviations.

    How much of the frame meets the map says nothing: where a camera goes on, the right place shows less of the map
    than the one it came from.
    """
    measures = result.measures
    off = measures["depth_residual_sigmas"] + measures["colour_residual_sigmas"]
    agreement = measures["agreement"]
    return agreement * off + (1.0 - agreement) * _UNMATCHED


class Doubt:
    """Knows how well predictions and alignments were of late.

    Alignment finds the right place from as far as a pixel of its coarsest images; from farther, it may find another
    one, as tiles, shelves and doors repeat.
    """

    def __init__(self, camera: Camera, coarsest: Camera) -> None:
        """coarsest: the camera of the coarsest images that frames are aligned in."""
        self._focal_px = camera.fx
        self._reach_px = camera.width / coarsest.width
        self._off_px = np.inf  # how far predictions were off of late: nothing is known yet
        self._misfits: deque[float] = deque(maxlen=_HISTORY)
        self.lost = False  # the last frame was

    def convincing(self, result: TrackingResult) -> bool:
        """Whether alignment alone shows that the camera is there, when it may have been carried anywhere.

        A wall, or a hand before the lens, meets some piece of the map from almost anywhere.
        """
        if result.lost:
            return False
        known = len(self._misfits) < _MIN_HISTORY or not self._unusual(result)
        return known and result.measures["overlap"] * result.measures["agreement"] >= _CONVINCING

    def about(self, result: TrackingResult, predicted: NDArray[np.float64], median_m: float) -> bool:
        """Whether a frame that was predicted at T_cw [4, 4] may well be elsewhere. median_m: its depth."""
        if result.lost or self._off_px > self._reach_px:
            return True
        return self._flow_px(result, predicted, median_m) > 2.0 * self._reach_px or self._unusual(result)

    def settle(self, result: TrackingResult, predicted: NDArray[np.float64], median_m: float) -> None:
        """The frame was predicted at T_cw [4, 4] and found there."""
        off_px = self._flow_px(result, predicted, median_m)
        known = np.isfinite(self._off_px)
        self._off_px = max(off_px, _MEMORY * self._off_px) if known else off_px
        self._misfits.append(misfit(result))
        self.lost = False

    def forget(self) -> None:
        """The camera was lost: nothing is known of how it moves."""
        self._off_px, self.lost = np.inf, True

    def _unusual(self, result: TrackingResult) -> bool:
        if len(self._misfits) < _MIN_HISTORY:
            return True
        return misfit(result) > _UNUSUAL * float(np.median(self._misfits))

    def _flow_px(self, result: TrackingResult, predicted: NDArray[np.float64], median_m: float) -> float:
        """By how much the image has moved against the prediction."""
        turn_rad, shift_m = np.split(se3_log(result.T_cw @ inverse(predicted)), 2)
        return self._focal_px * float(np.linalg.norm(turn_rad) + np.linalg.norm(shift_m) / max(median_m, 1e-6))
