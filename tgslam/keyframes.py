"""Keyframe selection by co-visibility (section 3.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.config.schema import KeyframeConfig
from tgslam.types import Frame


class KeyframeSelector:
    """Compares what a frame sees of the map with what the last keyframe saw.

    The map changes only at keyframes, so rows of the visibility masks mean the same Gaussians until the next one.
    """

    def __init__(self, config: KeyframeConfig) -> None:
        self.config = config
        self._seen: NDArray[np.bool_] = np.zeros(0, bool)
        self._last_index = 0

    def reset(self, frame: Frame, seen: NDArray[np.bool_]) -> None:
        """`frame` has become a keyframe, and sees these Gaussians [N] of the map as it is now."""
        self._seen, self._last_index = seen, frame.index

    def cue(self, frame: Frame, seen: NDArray[np.bool_], unexplained: float) -> str:
        """Why the frame should be a keyframe, "" if it should not.

        seen: [N] Gaussians in the frame's view. unexplained: share of the frame's pixels that the map leaves open.
        """
        union = int((seen | self._seen).sum())
        overlap = int((seen & self._seen).sum()) / max(union, 1)
        if overlap < self.config.min_overlap:
            return f"co-visibility: overlap {overlap:.2f}"
        if unexplained > self.config.max_unexplained:
            return f"co-visibility: {unexplained:.0%} of the frame is not in the map"
        if frame.index - self._last_index >= self.config.max_interval:
            return "interval"
        return ""
