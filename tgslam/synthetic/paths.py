"""Camera paths: smooth functions from time in s to camera-to-world poses [4, 4], with the sway of a hand."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tgslam.geometry import so3_exp
from tgslam.types import Matrix4

CameraPath = Callable[[float], Matrix4]

_SWAY = (  # frequency Hz, position amplitudes m, rotation amplitudes rad, phase rad
    (0.35, (0.006, 0.005, 0.008), (0.008, 0.010, 0.006), 0.3),
    (0.80, (0.003, 0.003, 0.004), (0.003, 0.003, 0.003), 1.7),
    (1.70, (0.0008, 0.0008, 0.001), (0.0012, 0.001, 0.0012), 4.1),
)


def pose_looking(x: float, y: float, z: float, yaw_rad: float, pitch_rad: float) -> Matrix4:
    """T_wc of a camera at (x, y, z) m looking along yaw (from +x to +y) and pitch (up positive), without roll."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    forward = np.array([c * np.cos(pitch_rad), s * np.cos(pitch_rad), np.sin(pitch_rad)])
    right = np.array([s, -c, 0.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = (x, y, z)
    return T


def with_sway(path: CameraPath, period_s: float | None = None) -> CameraPath:
    """Add a hand's sway to a path. With a period the frequencies become harmonics of it, so loops still close."""

    def swaying(time_s: float) -> Matrix4:
        T = path(time_s).copy()
        omega = np.zeros(3)
        for frequency, shift, turn, phase in _SWAY:
            hertz = frequency if period_s is None else max(round(frequency * period_s), 1) / period_s
            angles = 2 * np.pi * hertz * time_s + phase + np.array([0.0, 2.1, 4.2])
            T[:3, 3] += np.array(shift) * np.sin(angles)
            omega += np.array(turn) * np.sin(angles + 1.0)
        T[:3, :3] = T[:3, :3] @ so3_exp(omega)
        return T

    return swaying


def oval(
    period_s: float,
    centre: tuple[float, float],
    radii: tuple[float, float],
    height_m: float,
    first_yaw_rad: float,
    *,
    turns: int = 1,
    wander_rad: float = 0.2,
    pitch_rad: float = -0.12,
    first_angle_rad: float = 0.0,
) -> CameraPath:
    """Round an oval once a period while turning left by `turns` x 360 degrees, with a slow wander of the view."""

    def path(time_s: float) -> Matrix4:
        phase = 2 * np.pi * time_s / period_s
        around = phase + first_angle_rad
        return pose_looking(
            centre[0] + radii[0] * np.cos(around),
            centre[1] + radii[1] * np.sin(around),
            height_m + 0.06 * np.sin(2 * phase + 0.5),
            first_yaw_rad + turns * phase + wander_rad * np.sin(3 * phase),
            pitch_rad + 0.10 * np.sin(2 * phase + 1.0),
        )

    return with_sway(path, period_s)


def walk(corners_m: np.ndarray, speed_m_s: float, height_m: float) -> CameraPath:
    """Walk along the polyline `corners_m` [K, 2] with rounded corners, looking ahead and a little to the sides.

    Corners are rounded by a parabola, so that the velocity is continuous; past the last corner it goes straight on.
    """
    steps = np.diff(corners_m, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    directions = steps / lengths[:, None]
    yaws = np.unwrap(np.arctan2(directions[:, 1], directions[:, 0]))
    arrivals_s = np.cumsum(lengths) / speed_m_s
    starts_s = arrivals_s - lengths / speed_m_s
    round_s, turn_s = 0.9 / speed_m_s, 2.2

    def path(time_s: float) -> Matrix4:
        leg = min(int(np.searchsorted(arrivals_s, time_s, side="right")), len(lengths) - 1)
        position = corners_m[leg] + directions[leg] * speed_m_s * (time_s - starts_s[leg])
        yaw = yaws[max(leg - 1, 0)]
        for corner in range(max(leg - 1, 0), min(leg + 1, len(lengths) - 1)):  # legs are longer than turns
            late_s = time_s - arrivals_s[corner]
            share = float(np.clip(0.5 + late_s / (2 * turn_s), 0.0, 1.0))
            yaw += (yaws[corner + 1] - yaws[corner]) * share * share * (3 - 2 * share)
            if abs(late_s) < round_s:
                cut_m = speed_m_s * (round_s - abs(late_s)) ** 2 / (4 * round_s)
                position = position + cut_m * (directions[corner + 1] - directions[corner])
        glance = 0.30 * np.sin(2 * np.pi * time_s / 9.0) + 0.08 * np.sin(2 * np.pi * time_s / 3.7)
        pitch = -0.10 + 0.05 * np.sin(2 * np.pi * time_s / 5.3)
        return pose_looking(position[0], position[1], height_m, yaw + glance, pitch)

    return with_sway(path)
