"""What alignment needs of an image pair, fine to coarse: for the live frame and for the rendered model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tgslam import images, runtime
from tgslam.config.schema import LossConfig
from tgslam.types import Camera, Frame


@dataclass(frozen=True)
class LiveLevel:
    """One resolution of the live frame, as device arrays."""

    camera: Camera
    depth: np.ndarray  # [H, W] m
    grey: np.ndarray  # [H, W]
    grad_x: np.ndarray  # [H, W] 1/px
    grad_y: np.ndarray  # [H, W]
    gate: np.ndarray  # [H, W] T of Eq. 11


@dataclass(frozen=True)
class ModelLevel:
    """One resolution of the rendered model, as device arrays."""

    camera: Camera
    depth: np.ndarray  # [H, W] m, 0 = not covered by the map
    grey: np.ndarray  # [H, W]
    normal: np.ndarray  # [H, W, 3]
    grad_x: np.ndarray  # [H, W]
    grad_y: np.ndarray  # [H, W]
    grad_xx: np.ndarray  # [H, W]
    grad_xy: np.ndarray  # [H, W]
    grad_yy: np.ndarray  # [H, W]


def finest_level(camera: Camera, finest_width_px: int) -> int:
    """How often an image is halved until it is at most `finest_width_px` wide."""
    level = 0
    while camera.halved(level).width > finest_width_px:
        level += 1
    return level


def live_pyramid(frame: Frame, camera: Camera, first: int, levels: int, loss: LossConfig) -> list[LiveLevel]:
    """Levels of a frame, finest first: the frame halved `first` times, then once more for each next level."""
    depth, grey = runtime.to_device(frame.depth_m), images.luminance(runtime.to_device(frame.colour))
    for _ in range(first):
        depth, grey = images.halve_depth(depth), images.halve(grey)
    result = []
    for level in range(levels):
        if level:
            depth, grey = images.halve_depth(depth), images.halve(grey)
        grad_x, grad_y = images.sobel(grey)
        gate = images.texture_gate(grey, loss.gate_percentile, loss.gate_noise_floor)
        result.append(LiveLevel(camera.halved(first + level), depth, grey, grad_x, grad_y, gate))
    return result


def model_pyramid(
    grey: np.ndarray, depth: np.ndarray, camera: Camera, levels: int, sigma_per_m2: float
) -> list[ModelLevel]:
    """Levels of a rendered image pair, finest first. grey [H, W], depth [H, W] m with 0 where the map says nothing."""
    result = []
    for level in range(levels):
        if level:
            depth, grey = images.halve_depth(depth), images.halve(grey)
        level_camera = camera.halved(level)
        grad_x, grad_y = images.sobel(grey)
        grad_xx, grad_xy = images.sobel(grad_x)
        _, grad_yy = images.sobel(grad_y)
        normal = images.normals(depth, level_camera, radius=1, sigma_per_m2=sigma_per_m2)
        result.append(ModelLevel(level_camera, depth, grey, normal, grad_x, grad_y, grad_xx, grad_xy, grad_yy))
    return result
