"""When a tracked pose is not to be believed."""

from __future__ import annotations

from collections import deque

import numpy as np

from tgslam.config.tracking_settings import LostSettings

_HISTORY = 30  # tracked frames whose colour residual says what is usual here: a second
_MIN_HISTORY = 3  # of them, for their median to say anything
_PATIENCE = 15  # lost frames in a row that show something: half a second
_SOMETHING = 30  # features with depth: a place is recognised by hardly fewer


class LostDetector:
    """Weighs what a solver measured of its result against fixed bounds and against the frames before.

    Alignment finds some surface that fits in almost any image; what gives a wrong place away is that much of what
    should meet does not (`agreement`), and that the colours are off by far more than they were.
    """

    def __init__(self, config: LostSettings) -> None:
        self._config = config
        self._colour_residuals: deque[float] = deque(maxlen=_HISTORY)

    def judge(self, measures: dict[str, float]) -> str:
        """What speaks against a result, "" if nothing does.

        measures: overlap (share of the live pixels that meet the map), agreement (of those, with like depth),
        inlier_ratio (of those, within three sigma of the surface), colour_residual (intensity), condition (of the
        pose's information matrix).
        """
        config, usual = self._config, self._usual_colour_residual()
        if measures["overlap"] < config.min_map_overlap:
            return f"only {measures['overlap']:.0%} of the frame meets the map"
        if measures["agreement"] < config.min_map_agreement:
            return f"only {measures['agreement']:.0%} of what meets the map has its depth"
        if measures["inlier_ratio"] < config.min_inlier_ratio:
            return f"only {measures['inlier_ratio']:.0%} of the matched pixels lie within three sigma"
        if measures["colour_residual"] > usual:
            return f"the colours are off by {measures['colour_residual']:.2f}, more than {usual:.2f}"
        if not measures["condition"] < config.max_condition:
            return f"the pose is not determined (condition number {measures['condition']:.1e})"
        return ""

    def accept(self, measures: dict[str, float]) -> None:
        """They are those of a frame that was tracked: its residual joins the history."""
        self._colour_residuals.append(measures["colour_residual"])

    def _usual_colour_residual(self) -> float:
        if len(self._colour_residuals) < _MIN_HISTORY:
            return np.inf
        median = float(np.median(self._colour_residuals))
        return max(self._config.max_colour_ratio * median, self._config.sound_colour_residual)


class Patience:
    """How long a lost camera has looked at something that it does not know.

    Frames that are dark, covered or blurred say nothing, and neither does a blank wall.
    """

    def __init__(self) -> None:
        self._frames = 0

    def ends(self, features: int) -> bool:
        """Whether it is time for a new piece of the map, now that another lost frame shows so many features."""
        self._frames = self._frames + 1 if features >= _SOMETHING else 0
        return self._frames >= _PATIENCE

    def reset(self) -> None:
        """The camera is not lost any more."""
        self._frames = 0
