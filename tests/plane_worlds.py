"""Cameras in boxes of planes, without images: true poses, what each view says of the planes, and drifting odometry."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tgslam.geometry import inverse, se3_exp, tangent_axes
from tgslam.planes.estimate import PlaneEstimate
from tgslam.types import RelativePose

REACH_M = 5.0
SIGMA_RAD, SIGMA_M = 0.004, 0.003  # of a view of a plane
STEP_RAD, STEP_M = 0.003, 0.005  # of an odometry step


@dataclass(frozen=True)
class Box:
    """The inside of a box with a corner at the origin, y down: planes 0 to 5 are x, y, z = low, then high."""

    size_m: tuple[float, float, float]

    def plane(self, index: int) -> tuple[np.ndarray, float]:
        """Inward unit normal and d of n . x + d = 0, world."""
        axis, high = index % 3, index >= 3
        normal = np.zeros(3)
        normal[axis] = -1.0 if high else 1.0
        return normal, self.size_m[axis] if high else 0.0

    def views(self, T_cw: np.ndarray, rng: np.random.Generator, noise: float = 1.0) -> dict[int, PlaneEstimate]:
        """The planes in front of a camera, by index, in its frame, with `noise` times their standard errors."""
        found = {index: self._patch(index, T_cw) for index in range(6)}
        return {index: _seen(plane, rng, noise) for index, plane in found.items() if plane is not None}

    def _patch(self, index: int, T_cw: np.ndarray) -> PlaneEstimate | None:
        """The part of a plane that the camera looks at, exact; None where there is none."""
        normal, offset = self.plane(index)
        T_wc = inverse(T_cw)
        for ahead in (1.5, 2.5, 4.0):
            centre = T_wc[:3, 3] + ahead * T_wc[:3, 2]
            centre = np.clip(centre - (normal @ centre + offset) * normal, 0.0, self.size_m)
            x, y, z = T_cw[:3, :3] @ centre + T_cw[:3, 3]
            if 0.3 < z < REACH_M and max(abs(x), abs(y)) < 0.9 * z:
                world = PlaneEstimate(normal, np.asarray(offset), centre, tangent_axes(normal), np.eye(3))
                local = world.transformed(T_cw)
                covariance = np.diag([SIGMA_RAD**2, SIGMA_RAD**2, SIGMA_M**2])
                return PlaneEstimate(
                    local.normal, local.offset_m, local.centroid, tangent_axes(local.normal), covariance
                )
        return None


def _seen(plane: PlaneEstimate, rng: np.random.Generator, noise: float) -> PlaneEstimate:
    """With errors drawn from its covariance."""
    return shifted(plane, noise * np.linalg.cholesky(plane.covariance) @ rng.standard_normal(3))


def shifted(plane: PlaneEstimate, error: np.ndarray) -> PlaneEstimate:
    """Turned about its tangents and lifted at its centroid by (rad, rad, m)."""
    first, second = plane.axes
    normal = plane.normal - error[0] * second + error[1] * first
    normal = normal / np.linalg.norm(normal)
    centroid = plane.centroid + error[2] * plane.normal
    return PlaneEstimate(normal, np.asarray(-normal @ centroid), centroid, tangent_axes(normal), plane.covariance)


def looking(position: np.ndarray, heading_rad: float, pitch_rad: float = 0.0) -> np.ndarray:
    """T_cw [4, 4] of an upright camera at a place [3] m; heading 0 looks along +z, pitch > 0 downwards."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    yaw = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    T_wc = np.eye(4)
    T_wc[:3, :3] = yaw @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    T_wc[:3, 3] = position
    return inverse(T_wc)


def turning(size_m: tuple[float, float, float], count: int) -> list[np.ndarray]:
    """Poses of a camera in the middle of a box that turns once through 360 degrees."""
    middle = 0.5 * np.array(size_m)
    return [looking(middle, 2 * np.pi * k / (count - 1), 0.25) for k in range(count)]


def walking(size_m: tuple[float, float, float], count: int) -> list[np.ndarray]:
    """Poses of a camera that walks once along the z axis of a box, swaying and looking from side to side."""
    phase = np.linspace(0.0, 1.0, count)
    return [
        looking(
            np.array([size_m[0] / 2 + 0.2 * np.sin(20 * s), 1.2, 1.0 + (size_m[2] - 2.0) * s]),
            0.6 * np.sin(30 * s), 0.3 * np.sin(17 * s),
        )
        for s in phase
    ]  # fmt: skip


def odometry(truth: list[np.ndarray], rng: np.random.Generator, noise: float = 1.0) -> list[RelativePose]:
    """The motions from each pose to the next one, with `noise` times their standard errors."""
    sigma = np.array([STEP_RAD] * 3 + [STEP_M] * 3)
    return [
        RelativePose(se3_exp(noise * sigma * rng.standard_normal(6)) @ b @ inverse(a), np.diag(sigma**-2.0))
        for a, b in pairwise(truth)
    ]


def position_errors_m(T_cw: np.ndarray, truth: list[np.ndarray]) -> np.ndarray:
    """[K] m of cameras' positions; the first poses coincide."""
    return np.linalg.norm(inverse(T_cw)[:, :3, 3] - inverse(np.array(truth))[:, :3, 3], axis=1)
