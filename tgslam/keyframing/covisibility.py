"""Keyframe selection by co-visibility (section 3.1) and baseline."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.config.tracking_settings import KeyframeConfig
from tgslam.device import runtime
from tgslam.geometry import inverse
from tgslam.ops import image as images
from tgslam.types import Frame

# Where a camera is so fast that each frame shows much that is new, those right after a keyframe are none unless they
# show far more: the next one shows most of it as well, and refining each of them would take the time of a frame
_SOON = 3  # frames
_MUCH = 3.0  # times what else is too much: of what frames do not share, what the map lacks, and motion


class KeyframeSelector:
    """Compares what a frame sees of the map with what the last keyframe saw.

    The map changes only at keyframes, so rows of the visibility masks mean the same Gaussians until the next one.
    """

    def __init__(self, config: KeyframeConfig) -> None:
        self.config = config
        self._seen: NDArray[np.bool_] = np.zeros(0, bool)
        self._last_index, self._asked = 0, 0
        self._T_cw: NDArray[np.float64] = np.eye(4)

    def reset(self, frame: Frame, T_cw: NDArray[np.float64], seen: NDArray[np.bool_]) -> None:
        """`frame` has become a keyframe at T_cw [4, 4], and sees these Gaussians [N] of the map as it is now."""
        self._seen, self._T_cw, self._last_index, self._asked = seen, T_cw, frame.index, 0

    def cue(self, frame: Frame, T_cw: NDArray[np.float64], seen: NDArray[np.bool_], unexplained: float) -> str:
        """Why the frame, tracked at T_cw [4, 4], should be a keyframe, "" if it should not. Asked once of each frame.

        The frame's depth may lie on the host or on the device. seen: [N] Gaussians in the frame's view. unexplained:
        share of the frame's pixels that the map leaves open.
        """
        self._asked += 1
        much = 1.0 if self._asked >= _SOON else _MUCH
        union = int((seen | self._seen).sum())
        overlap = int((seen & self._seen).sum()) / max(union, 1)
        if 1.0 - overlap > much * (1.0 - self.config.min_covisibility):
            return f"co-visibility: overlap {overlap:.2f}"
        if unexplained > much * self.config.max_unexplained:
            return f"co-visibility: {unexplained:.0%} of the frame is not in the map"
        moved_m = float(np.linalg.norm(inverse(T_cw)[:3, 3] - inverse(self._T_cw)[:3, 3]))
        if moved_m > much * self.config.max_translation * images.median_of_measured(runtime.to_device(frame.depth_m)):
            return f"baseline: {moved_m:.2f} m"
        if frame.index - self._last_index >= self.config.max_interval:
            return "interval"
        return ""
