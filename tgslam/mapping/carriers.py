"""Which keyframes carry each Gaussian: those that its place was averaged from, and that it follows when they move."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class CarrierDraw:
    """Keeps a fair sample of the keyframes behind each Gaussian.

    A place is a mean over keyframes, weighed by what each of them knew (`mapping.fusion`). Averaged again after they
    have moved, it would have moved by the same mean of their motions. All of them would be too many to keep, so there
    are a few slots that hold each keyframe as often as its weight has it, in expectation.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def __call__(self, carriers: NDArray[np.int32], keyframe: int, gain: NDArray[np.float64]) -> NDArray[np.int32]:
        """The carriers [n, S] of Gaussians, once a keyframe has moved them by `gain` [n] of the way to where it sees
        them.

        The draw is the same for all rows, so that neighbours with one history keep on moving alike, and stratified: of
        eight slots, a gain of 0.3 takes two or three.
        """
        drawn, slots = carriers.copy(), carriers.shape[1]
        thresholds = (self._rng.permutation(slots) + self._rng.random()) / slots
        drawn[thresholds[None] < gain[:, None]] = keyframe
        return drawn
