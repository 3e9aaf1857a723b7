"""Depth that has a camera of its own: where its pixels look, and how it comes into the pixels of the colour camera."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.input_settings import DatasetConfig, DepthCameraConfig
from tgslam.datasets.calibration import DISTORTION_LENGTHS, Calibration
from tgslam.errors import ConfigError, DatasetError
from tgslam.geometry import matrix_from_quat_wxyz, orthonormalized
from tgslam.types import FloatImage, Matrix4

_log = logging.getLogger(__name__)
_SAME_SHAPE = 0.01  # of the ratio of the sides
_NOT_ORTHONORMAL = 0.01  # largest entry of R^T R - I
_FARTHEST_M = 2.0  # between the cameras of one device: more are millimetres

Register = Callable[[FloatImage], FloatImage]  # depth [H, W] m of the depth camera -> [h, w] of the colour camera


@dataclass(frozen=True)
class DepthCamera:
    """The camera of stored depth images, and where it is for the colour camera."""

    calibration: Calibration
    T_colour_depth: Matrix4  # [4, 4]

    def rays(self, width: int, height: int) -> NDArray[np.float64]:
        """[H, W, 2] x/z and y/z that each pixel of the stored images looks along."""
        v, u = np.mgrid[:height, :width]
        at = np.stack([u, v], -1).reshape(-1, 1, 2).astype(np.float64)
        coefficients = np.asarray(self.calibration.distortion, np.float64)
        return np.asarray(cv2.undistortPoints(at, self.calibration.matrix, coefficients).reshape(height, width, 2))


def register_to(colour: Camera, depth: DepthCamera, size: tuple[int, int]) -> Register:
    """What brings depth images of a size, (width, height) px, into the pixels of the colour camera, by a kernel."""
    from tgslam.ops.registration import Registration  # brings in the kernels, which other recordings do without

    return Registration(depth.rays(*size), depth.T_colour_depth, colour)


def registration_of(
    config: DatasetConfig, calibration: Calibration, colour: Camera, size: tuple[int, int]
) -> Register | None:
    """What the settings, or the size of depth images, (width, height) px, ask for; None: depth lies on colour.

    calibration: of the stored colour images. Depth of another resolution, but of the same shape, is taken to show what
    colour does. Raises ConfigError for a depth camera that cannot be, and DatasetError for depth of another shape
    without one.
    """
    if config.depth_camera != DepthCameraConfig():
        if calibration.flips_rows:
            raise ConfigError("dataset.depth_camera does not go with a negative dataset.fy, whose images are flipped")
        return register_to(colour, depth_camera(config.depth_camera, size), size)
    if size == (colour.width, colour.height):
        return None
    across, down = size[0] / colour.width, size[1] / colour.height
    if abs(across / down - 1.0) > _SAME_SHAPE:
        raise DatasetError(
            f"depth images are {size[0]}x{size[1]}, colour images {colour.width}x{colour.height}: their shapes differ, "
            "so depth has a camera of its own; set dataset.depth_camera, or register depth to colour first"
        )
    _log.info(
        "depth images are %dx%d, colour images %dx%d: taken as the same view, and brought to the size of colour; "
        "dataset.depth_camera overrules that", *size, colour.width, colour.height,
    )  # fmt: skip
    distortion = () if calibration.flips_rows else calibration.distortion
    scaled = Calibration(
        colour.fx * across,
        colour.fy * down,
        (colour.cx + 0.5) * across - 0.5,
        (colour.cy + 0.5) * down - 0.5,
        distortion,
    )
    return register_to(colour, DepthCamera(scaled, np.eye(4)), size)


def depth_camera(config: DepthCameraConfig, size: tuple[int, int]) -> DepthCamera:
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
