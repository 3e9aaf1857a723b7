"""Cameras of a ROS bag: sensor_msgs/CameraInfo, static transforms, and what RealSense's recorder adds.

RealSense: https://github.com/IntelRealSense/librealsense/blob/master/src/media/readme.md. A topic .../tf/0 holds the
transform from a point of reference to the stream, and .../option/Depth_Units/value the metres of a unit of depth.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from tgslam.datasets.calibration import Calibration
from tgslam.errors import ConfigError
from tgslam.geometry import inverse, matrix_from_quat_wxyz
from tgslam.types import Matrix4

_PINHOLES = ("plumb_bob", "rational_polynomial", "brown conrady", "inverse brown conrady", "none", "pinhole", "")
_LENGTHS = (4, 5, 8, 12, 14)  # of OpenCV's distortion models


def nearest_topic(topics: Iterable[str], image_topic: str) -> str | None:
    """Of some topics the one that has most in common with the name of an image's topic, from its start."""

    def alike(topic: str) -> int:
        return [*(a == b for a, b in zip(topic, image_topic, strict=False)), False].index(False)

    return max(sorted(topics), key=alike, default=None)


def calibration_of(info: Any, image_topic: str, name: str) -> Calibration | None:
    """A CameraInfo; None for an empty one. Raises ConfigError for distortion that is none of OpenCV's."""
    K = np.asarray(_either(info, "K", "k"), np.float64).reshape(3, 3)
    D = tuple(float(value) for value in _either(info, "D", "d"))
    P = np.asarray(_either(info, "P", "p"), np.float64).reshape(3, 4)
    size = int(info.width), int(info.height)
    if "rect" in image_topic and P[0, 0] > 0:
        K, D = P[:, :3], ()
    if not K[0, 0] > 0 or min(size) < 1:
        return None
    if any(D) and info.distortion_model.lower() not in _PINHOLES:
        raise ConfigError(
            f"{name}: the distortion of its camera is {info.distortion_model!r}, which is not known; rectify the images"
        )
    length = next((length for length in _LENGTHS if length >= len(D)), _LENGTHS[-1])
    distortion = (*D, *[0.0] * length)[:length] if any(D) else ()
    return Calibration(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), distortion, size)


def _either(message: Any, upper: str, lower: str) -> Any:
    """ROS 1 writes K where ROS 2 writes k."""
    return getattr(message, upper) if hasattr(message, upper) else getattr(message, lower)


def matrix_of(transform: Any) -> Matrix4:
    """[4, 4] of a geometry_msgs/Transform; its quaternion may have any length but zero."""
    t, q = transform.translation, transform.rotation
    T = np.eye(4)
    quat = np.array([q.w, q.x, q.y, q.z])
    if np.linalg.norm(quat) > 1e-9:
        T[:3, :3] = matrix_from_quat_wxyz(quat)
    T[:3, 3] = t.x, t.y, t.z
    return T


class StaticFrames:
    """Frames that do not move against each other, by name."""

    def __init__(self) -> None:
        self._edges: dict[str, list[tuple[str, Matrix4]]] = {}

    def add(self, parent: str, child: str, T_parent_child: Matrix4) -> None:
        """What a message of /tf_static says."""
        self._edges.setdefault(parent, []).append((child, T_parent_child))
        self._edges.setdefault(child, []).append((parent, inverse(T_parent_child)))

    def between(self, target: str, source: str) -> Matrix4 | None:
        """T_target_source; None where no chain joins the two."""
        found = {target: np.eye(4)}
        todo = [target]
        while todo and source not in found:
            frame = todo.pop()
            for other, T in self._edges.get(frame, ()):
                if other not in found:
                    found[other] = found[frame] @ T
                    todo.append(other)
        return found.get(source)
