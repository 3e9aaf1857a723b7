"""Constant-velocity prediction of the next pose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.geometry import inverse, se3_exp, se3_log


class ConstantVelocity:
    """Predicts T_cw by repeating the last motion, scaled by the time between frames."""

    def __init__(self) -> None:
        self._last: tuple[float, NDArray[np.float64]] | None = None
        self._velocity = np.zeros(6)  # rad/s, m/s

    def predict(self, timestamp_s: float) -> NDArray[np.float64]:
        """T_cw [4, 4] at that time."""
        if self._last is None:
            return np.eye(4)
        last_s, T_cw = self._last
        return se3_exp(self._velocity * (timestamp_s - last_s)) @ T_cw

    def update(self, timestamp_s: float, T_cw: NDArray[np.float64]) -> None:
        """Take in a tracked pose."""
        if self._last is not None and timestamp_s > self._last[0]:
            self._velocity = se3_log(T_cw @ inverse(self._last[1])) / (timestamp_s - self._last[0])
        self._last = (timestamp_s, T_cw)

    def move(self, motion: NDArray[np.float64]) -> None:
        """The world around the camera has moved, p_w <- motion p_w [4, 4]; its velocity is as it was."""
        if self._last is not None:
            self._last = (self._last[0], self._last[1] @ inverse(motion))

    def slow_down(self) -> None:
        """Believe in half the velocity: where tracking is lost, the last one soon tells nothing."""
        self._velocity = self._velocity / 2.0
