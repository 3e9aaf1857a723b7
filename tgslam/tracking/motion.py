"""Where the camera will be at the next frame, and how far that can be trusted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.config.tracking_settings import MotionSettings
from tgslam.geometry import inverse, se3_exp, se3_log

_LEAST_S = 1.0 / 120.0  # between frames whose timestamps say less: no camera is faster

_LEARNT = 0.2  # share of the last frame in how fast a camera is believed to accelerate
_BY_CHANCE = 9.0  # squared standard deviations that predictions are off by at times, with nothing to be learnt from it


class MotionFilter:
    """Kalman filter of the camera's pose and velocity, which changes by accelerations that nothing foretells.

    A velocity that is taken from the last two poses alone has all of their noise, and where nothing in view holds the
    camera, it slides along with that. The state is T_cw and its left perturbation's velocity (rad/s, m/s). That the
    perturbation's axes turn with the camera from a frame to the next is neglected in the covariances.
    """

    def __init__(self, config: MotionSettings) -> None:
        self._acceleration = np.diag(np.array([config.acceleration_rad] * 3 + [config.acceleration_m] * 3) ** 2)
        self._rest = np.diag(np.array([config.speed_rad] * 3 + [config.speed_m] * 3) ** 2)
        self._excess: NDArray[np.float64] = np.ones(
            6
        )  # variances of this camera's accelerations, as multiples of those
        self._last: tuple[float, NDArray[np.float64]] | None = None
        self._lost = False  # whether the last pose is only where the camera coasted to
        self._velocity: NDArray[np.float64] = np.zeros(6)
        # covariances [6, 6] of the last pose, of it with the velocity, and of that
        self._poses: NDArray[np.float64] = np.zeros((6, 6))
        self._crossed: NDArray[np.float64] = np.zeros((6, 6))
        self._velocities: NDArray[np.float64] = self._rest

    def predict(self, timestamp_s: float) -> NDArray[np.float64]:
        """T_cw [4, 4] at that time."""
        if self._last is None:
            return np.eye(4)
        last_s, T_cw = self._last
        return se3_exp(self._velocity * (timestamp_s - last_s)) @ T_cw

    def information(self, timestamp_s: float) -> NDArray[np.float64]:
        """[6, 6] of the prediction's left perturbation: none before the first pose, and none while the camera is lost.

        Cameras in hands and on robots do not jump.
        """
        if self._last is None or self._lost:
            return np.zeros((6, 6))
        return np.asarray(np.linalg.inv(self._predicted(timestamp_s)[0]), np.float64)

    def update(self, timestamp_s: float, T_cw: NDArray[np.float64], information: NDArray[np.float64]) -> None:
        """Take in the pose that a frame was tracked to, and what its images say of it: [6, 6] as in `TrackingResult`.

        The pose is what images and prediction agree on: it enters as the state's, not as a measurement of it.
        """
        if self._lost:
            self._start()
        elif self._last is not None and timestamp_s > self._last[0]:
            innovation = se3_log(T_cw @ inverse(self.predict(timestamp_s)))
            self._learn(innovation, self._predicted(timestamp_s)[0])
            poses, crossed, velocities = self._predicted(timestamp_s)
            prior = np.linalg.inv(poses)
            gain = crossed.T @ prior
            self._velocity = self._velocity + gain @ innovation
            self._poses = np.asarray(np.linalg.inv(prior + information), np.float64)
            self._crossed = self._poses @ gain.T
            self._velocities = velocities - gain @ (poses - self._poses) @ gain.T
        self._last, self._lost = (timestamp_s, T_cw), False

    def coast(self, timestamp_s: float, T_cw: NDArray[np.float64]) -> None:
        """No pose was found: the camera may be at T_cw, and slows down, since its velocity soon tells little."""
        self._last, self._lost = (timestamp_s, T_cw), True
        self._velocity = self._velocity / 2.0

    def move(self, motion: NDArray[np.float64]) -> None:
        """The world around the camera has moved, p_w <- motion p_w [4, 4]; its velocity is as it was."""
        if self._last is not None:
            self._last = (self._last[0], self._last[1] @ inverse(motion))

    def _learn(self, innovation: NDArray[np.float64], poses: NDArray[np.float64]) -> None:
        """Drones, and recordings whose times are invented, are farther from predictions than hands allow.

        innovation: [6] from the predicted to the tracked pose, poses: [6, 6] its covariance. Where pixels leave a
        direction free, the camera follows the prediction and says nothing of it: so no less than hands do is believed.
        """
        for part in (slice(0, 3), slice(3, 6)):
            surprise = float(innovation[part] @ innovation[part]) / float(np.trace(poses[part, part]))
            growth = 1.0 + _LEARNT * (surprise - 1.0) if surprise > _BY_CHANCE else 1.0 - _LEARNT
            self._excess[part] = np.maximum(growth * self._excess[part], 1.0)

    def _start(self) -> None:
        """The next pose to come counts as known, its velocity as unknown."""
        self._velocity = np.zeros(6)
        self._poses, self._crossed, self._velocities = np.zeros((6, 6)), np.zeros((6, 6)), self._rest

    def _predicted(self, timestamp_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """The covariances [6, 6] of pose, of pose and velocity, and of velocity at that time.

        The velocity changes just after the last frame: were it by an acceleration that lasts, exact poses would have it
        swing about the true one.
        """
        assert self._last is not None
        dt = max(timestamp_s - self._last[0], _LEAST_S)
        velocities = self._velocities + dt**2 * self._excess * self._acceleration
        crossed = self._crossed + dt * velocities
        return self._poses + dt * (self._crossed + self._crossed.T) + dt**2 * velocities, crossed, velocities


def unopposed(prior: NDArray[np.float64], information: NDArray[np.float64]) -> NDArray[np.float64]:
    """The information [6, 6] of a prior in directions where there is none else; next to nothing in the others.

    Both are of the same perturbation. Along directions that are independent in either, where the other is r times as
    strong, the prior counts by 1 / (1 + r)^2: what pixels measure well is not drawn to where the camera was expected.
    """
    if not prior.any():
        return prior
    root = np.linalg.cholesky(prior)
    whitening = np.linalg.inv(root)
    strength, axes = np.linalg.eigh(whitening @ information @ whitening.T)
    axes = root @ axes
    return np.asarray((axes / (1.0 + np.maximum(strength, 0.0)) ** 2) @ axes.T, np.float64)
