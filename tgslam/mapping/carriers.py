"""Which keyframes carry each Gaussian: those that its place was averaged from, and that it follows when they move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SLOTS = 8  # twice as many move the map no better, half as many tear it a little


class Carriers:
    """A fair sample of the keyframes behind each Gaussian.

    A place is a mean over keyframes, weighed by what each of them knew (`mapping.fusion`). Averaged again after they
    have moved, it would have moved by the same mean of their motions. All of them would be too many to keep, so there
    are a few slots that hold each keyframe as often as its weight has it, in expectation.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.keyframes = np.zeros((0, _SLOTS), np.int32)  # [N, S]

    def append(self, keyframes: NDArray[np.int32]) -> None:
        """Add rows, carried by these keyframes [n, S], or one each [n]."""
        wide = keyframes if keyframes.ndim == 2 else np.repeat(keyframes[:, None], _SLOTS, 1)
        self.keyframes = np.concatenate([self.keyframes, wide])

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Remove the rows where the mask [N] is false."""
        self.keyframes = self.keyframes.take(np.flatnonzero(mask), axis=0)

    def learn(self, rows: NDArray[np.intp], keyframe: int, gain: NDArray[np.float64]) -> None:
        """A keyframe has moved the places of these rows [n] by `gain` [n] of the way to where it sees them.

        The draw is the same for all rows, so that neighbours with one history keep on moving alike, and stratified: of
        eight slots, a gain of 0.3 takes two or three.
        """
        thresholds = (self._rng.permutation(_SLOTS) + self._rng.random()) / _SLOTS
        for slot, threshold in enumerate(thresholds):
            self.keyframes[rows[threshold < gain], slot] = keyframe
