"""Where every frame was: each relative to its keyframe, so that a correction of keyframes rewrites nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.geometry import inverse, orthonormalized
from tgslam.map.keyframes import Keyframes
from tgslam.types import Matrix4, Trajectory

_FIRST_CAPACITY = 256


class FramePoses:
    """The frames of a run in their order, each tied to the keyframe that was the latest when it came."""

    def __init__(self, keyframes: Keyframes) -> None:
        self._keyframes = keyframes
        self._count = 0
        self._timestamps_s: NDArray[np.float64] = np.zeros(_FIRST_CAPACITY)
        self._keyframe: NDArray[np.int64] = np.zeros(_FIRST_CAPACITY, np.int64)
        self._T_ck: NDArray[np.float64] = np.zeros((_FIRST_CAPACITY, 4, 4))  # keyframe's camera to the frame's
        self._T_wc: NDArray[np.float64] = np.zeros((_FIRST_CAPACITY, 4, 4))  # of the first frames, as of a version
        self._known = 0  # how many
        self._version = keyframes.version

    def add(self, timestamp_s: float, T_cw: Matrix4 | None = None) -> None:
        """The next frame, at T_cw [4, 4]; None = it is the latest keyframe."""
        if self._count == len(self._timestamps_s):
            self._grow()
        number = len(self._keyframes) - 1
        T_ck = np.eye(4)
        if T_cw is not None:
            T_ck = orthonormalized(T_cw @ inverse(self._keyframes[number].T_cw))
        self._timestamps_s[self._count], self._keyframe[self._count] = timestamp_s, number
        self._T_ck[self._count] = T_ck
        self._count += 1

    def latest_T_cw(self) -> Matrix4:
        """[4, 4] where the last frame is, as its keyframe stands now."""
        last = self._count - 1
        T_cw: Matrix4 = self._T_ck[last] @ self._keyframes[int(self._keyframe[last])].T_cw
        return T_cw

    def trajectory(self) -> Trajectory:
        """Camera-to-world poses of all frames. Asked for after each frame, only what is new is computed."""
        if self._version != self._keyframes.version:
            self._version, self._known = self._keyframes.version, 0
        new = slice(self._known, self._count)
        if self._known < self._count:
            T_cw = np.stack([self._keyframes[int(k)].T_cw for k in self._keyframe[new]])
            self._T_wc[new] = inverse(self._T_ck[new] @ T_cw)
            self._known = self._count
        return Trajectory(self._timestamps_s[: self._count].copy(), self._T_wc[: self._count].copy())

    def _grow(self) -> None:
        """Twice the capacity."""
        self._timestamps_s, self._keyframe, self._T_ck, self._T_wc = (
            np.concatenate([array, np.zeros_like(array)])
            for array in (self._timestamps_s, self._keyframe, self._T_ck, self._T_wc)
        )
