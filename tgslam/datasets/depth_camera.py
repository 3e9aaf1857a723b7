"""Depth that has a camera of its own: where its pixels look, and how it comes into the pixels of the colour camera."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.input_settings import DatasetConfig, DepthCameraConfig
from tgslam.datasets.calibration import DISTORTION_LENGTHS, Calibration, DepthCamera
from tgslam.datasets.stored import StoredRecording
from tgslam.errors import ConfigError
from tgslam.geometry import matrix_from_quat_wxyz, orthonormalized
from tgslam.types import FloatImage, Matrix4

_NOT_ORTHONORMAL = 0.01  # largest entry of R^T R - I
_FARTHEST_M = 2.0  # between the cameras of one device: more are millimetres


class Register(Protocol):
    """Brings depth [H, W] m of the depth camera into the pixels of the colour camera, [h, w]."""

    stored_shape: tuple[int, int]  # (H, W)

    def __call__(self, depth_m: FloatImage) -> FloatImage:
        """A new array."""


def rays_of(calibration: Calibration, width: int, height: int) -> NDArray[np.float64]:
    """[H, W, 2] x/z and y/z that each pixel of stored images looks along."""
    v, u = np.mgrid[:height, :width]
    at = np.stack([u, v], -1).reshape(-1, 1, 2).astype(np.float64)
    coefficients = np.asarray(calibration.distortion, np.float64)
    return np.asarray(cv2.undistortPoints(at, calibration.matrix, coefficients).reshape(height, width, 2))


def register_to(colour: Camera, depth: DepthCamera, size: tuple[int, int]) -> Register:
    """What brings depth images of a size, (width, height) px, into the pixels of the colour camera, by a kernel."""
    from tgslam.ops.registration import Registration  # brings in the kernels, which other recordings do without

    return Registration(rays_of(depth.calibration, *size), depth.T_colour_depth, colour)


def own_depth_camera(config: DatasetConfig, recording: StoredRecording, size: tuple[int, int]) -> DepthCamera | None:
    """The depth camera that the settings name, else that of the recording; None: depth shows what colour shows.

    size: of the depth images, (width, height) px. Raises ConfigError for a depth camera that cannot be.
    """
    found = recording.depth_camera
    if config.depth_camera != DepthCameraConfig():
        found = configured_depth_camera(config.depth_camera, size)
    elif found is not None:
        own = found.calibration
        if not (np.isfinite(own.matrix).all() and own.fx > 0 and own.fy > 0):
            numbers = f"{own.fx:g}, {own.fy:g}, {own.cx:g}, {own.cy:g}"
            raise ConfigError(f"{recording.name}: no depth camera has fx, fy, cx, cy of {numbers} px")
    if found is not None and recording.calibration.flips_rows:
        raise ConfigError("a depth camera of its own does not go with a negative dataset.fy, whose images are flipped")
    return found


def configured_depth_camera(config: DepthCameraConfig, size: tuple[int, int]) -> DepthCamera:
    """The camera that the settings describe, for images of a size, (width, height) px. Raises ConfigError."""
    key = "dataset.depth_camera"
    if len(config.intrinsics) != 4 or min(config.intrinsics[:2]) <= 0.0:
        raise ConfigError(f"{key}.intrinsics must be fx, fy, cx, cy in px, with fx and fy above 0")
    if config.lens and len(config.lens) not in DISTORTION_LENGTHS:
        raise ConfigError(
            f"{key}.lens has {len(config.lens)} values; OpenCV's models have "
            f"{', '.join(map(str, DISTORTION_LENGTHS))} (k1, k2, p1, p2, k3, ...)"
        )
    if config.size and tuple(config.size) != size:
        raise ConfigError(
            f"{key} is for images of {'x'.join(map(str, config.size))}, but depth images are {size[0]}x{size[1]}; "
            "multiply its intrinsics by the ratio, and set its size to theirs"
        )
    fx, fy, cx, cy = config.intrinsics
    if not (0 <= cx < size[0] and 0 <= cy < size[1]):
        raise ConfigError(
            f"{key}.intrinsics: the principal point ({cx:g}, {cy:g}) px lies outside images of {size[0]}x{size[1]}; "
            "are they for another size?"
        )
    return DepthCamera(Calibration(fx, fy, cx, cy, tuple(config.lens), size), motion_of(config.T_colour_depth))


def motion_of(values: tuple[float, ...]) -> Matrix4:
    """T_colour_depth [4, 4] of the setting. Raises ConfigError for what is no motion between two cameras."""
    key, T = "dataset.depth_camera.T_colour_depth", np.eye(4)
    if len(values) == 7 and np.linalg.norm(values[3:]) > 1e-6:
        T[:3, :3] = matrix_from_quat_wxyz(np.array([values[6], *values[3:6]]))
        T[:3, 3] = values[:3]
    elif len(values) in (12, 16):
        T[:3] = np.array(values[:12]).reshape(3, 4)
    elif values:
        raise ConfigError(f"{key} has {len(values)} values; give tx ty tz qx qy qz qw, or 12 or 16 of a matrix")
    R = T[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > _NOT_ORTHONORMAL or np.linalg.det(R) < 0:
        raise ConfigError(f"{key}: its rotation is none: rows must be of length 1, at right angles, and no mirror")
    far_m = float(np.linalg.norm(T[:3, 3]))
    if far_m > _FARTHEST_M:
        raise ConfigError(f"{key}: the cameras are {far_m:g} m apart; is its translation in millimetres?")
    return orthonormalized(T)
