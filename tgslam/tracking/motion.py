"""Constant-velocity prediction of the next pose, and how far it can be trusted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.config.schema import TrackingConfig
from tgslam.geometry import inverse, se3_exp, se3_log

_LEAST_S = 1.0 / 120.0  # between frames whose timestamps say less


class ConstantVelocity:
    """Predicts T_cw by repeating the last motion, scaled by the time between frames."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._last: tuple[float, NDArray[np.float64]] | None = None
        self._velocity = np.zeros(6)  # rad/s, m/s
        self._known = False  # whether that was seen
        self._lost = False  # whether the last pose is only where the camera coasted to

    def predict(self, timestamp_s: float) -> NDArray[np.float64]:
        """T_cw [4, 4] at that time."""
        if self._last is None:
            return np.eye(4)
        last_s, T_cw = self._last
        return se3_exp(self._velocity * (timestamp_s - last_s)) @ T_cw

    def information(self, timestamp_s: float) -> NDArray[np.float64]:
        """[6, 6] of the prediction's left perturbation: none before the first pose, and none while the camera is lost.

        Cameras in hands and on robots do not jump: as much as they accelerate between frames is what is uncertain, and
        all of the velocity while there is none.
        """
        if self._last is None or self._lost:
            return np.zeros((6, 6))
        elapsed_s = max(timestamp_s - self._last[0], _LEAST_S)
        turn_rad = self._config.acceleration_rad * elapsed_s**2
        shift_m = self._config.acceleration_m * elapsed_s**2
        if not self._known:
            turn_rad += self._config.speed_rad * elapsed_s
            shift_m += self._config.speed_m * elapsed_s
        return np.diag(np.array([turn_rad] * 3 + [shift_m] * 3) ** -2.0)

    def update(self, timestamp_s: float, T_cw: NDArray[np.float64]) -> None:
        """Take in a tracked pose."""
        if self._last is not None and timestamp_s > self._last[0]:
            self._velocity = se3_log(T_cw @ inverse(self._last[1])) / (timestamp_s - self._last[0])
            self._known = not self._lost
        self._last, self._lost = (timestamp_s, T_cw), False

    def move(self, motion: NDArray[np.float64]) -> None:
        """The world around the camera has moved, p_w <- motion p_w [4, 4]; its velocity is as it was."""
        if self._last is not None:
            self._last = (self._last[0], self._last[1] @ inverse(motion))

    def slow_down(self) -> None:
        """Believe in half the velocity: where tracking is lost, the last one soon tells nothing."""
        self._velocity = self._velocity / 2.0
        self._lost = True
