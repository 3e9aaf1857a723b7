"""EWA projection of 3D Gaussians in float64, with covariances as whole matrices.

A camera-frame Gaussian N(x, S) seen through the linearised projection J is the image Gaussian N(u, J S J^T + BLUR I).
Depth and pixel are then jointly Gaussian, and E[z | pixel] is affine in the pixel offset with slope
cov(z, uv) cov(uv)^-1: for a flat Gaussian that is the plane it lies in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.geometry import matrix_from_quat_wxyz, transform_points
from tgslam.kernels.projection import BLUR, BLUR_DEPTH, EDGE, NEAR_M
from tgslam.types import Gaussians

Array = NDArray[np.float64]
Parameters = dict[str, Array]
NAMES = ("mean", "log_scale", "quat_wxyz", "opacity_logit", "colour", "embedding")


@dataclass(frozen=True)
class Splats:
    """Screen-space Gaussians, in the map's order."""

    uv: Array  # [N, 2] px
    precision: Array  # [N, 2, 2] 1/px^2, inverse covariance
    opacity: Array  # [N]
    depth: Array  # [N] m, of the centre
    slope: Array  # [N, 2] m/px, of E[z | pixel]
    colour: Array  # [N, 3]
    embedding: Array  # [N, 3] instance colour
    in_front: NDArray[np.bool_]  # [N]


def parameters(gaussians: Gaussians) -> Parameters:
    """The differentiable parameters as float64 copies."""
    return {name: np.array(getattr(gaussians, name), np.float64) for name in NAMES}


def sigmoid(x: Array) -> Array:
    """Logistic function."""
    return 0.5 + 0.5 * np.tanh(0.5 * x)


def jacobian(points_c: Array, camera: Camera) -> Array:
    """[N, 2, 3] of (u, v) in the point; off the image's surroundings it is that of the nearest direction inside."""
    margin = 0.5 * (EDGE - 1.0)
    x, y, z = points_c.T
    tan_x = np.clip(
        x / z, (-margin * camera.width - camera.cx) / camera.fx, ((1 + margin) * camera.width - camera.cx) / camera.fx
    )
    tan_y = np.clip(
        y / z, (-margin * camera.height - camera.cy) / camera.fy, ((1 + margin) * camera.height - camera.cy) / camera.fy
    )
    J = np.zeros((len(points_c), 2, 3))
    J[:, 0, 0], J[:, 0, 2] = camera.fx / z, -camera.fx * tan_x / z
    J[:, 1, 1], J[:, 1, 2] = camera.fy / z, -camera.fy * tan_y / z
    return J


def camera_covariance(p: Parameters, T_cw: Array) -> Array:
    """[N, 3, 3] m^2, camera frame."""
    R = T_cw[:3, :3] @ matrix_from_quat_wxyz(p["quat_wxyz"])
    return R @ (np.exp(2.0 * p["log_scale"])[:, :, None] * np.swapaxes(R, 1, 2))


def project(p: Parameters, T_cw: Array, camera: Camera) -> Splats:
    """Gaussians -> splats; values of Gaussians that are not `in_front` mean nothing."""
    points_c = transform_points(T_cw, p["mean"])
    in_front = points_c[:, 2] > NEAR_M
    points_c = np.where(in_front[:, None], points_c, [0.0, 0.0, 1.0])
    J = jacobian(points_c, camera)
    S = camera_covariance(p, T_cw)
    screen = J @ S @ np.swapaxes(J, 1, 2)
    precision = np.linalg.inv(screen + BLUR * np.eye(2))
    regression = np.linalg.inv(screen + BLUR_DEPTH * np.eye(2))
    depth_uv = (S @ np.swapaxes(J, 1, 2))[:, 2, :]  # cov(z, uv)
    return Splats(
        uv=points_c[:, :2] / points_c[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy],
        precision=precision,
        opacity=sigmoid(p["opacity_logit"]),
        depth=points_c[:, 2],
        slope=np.einsum("ni,nij->nj", depth_uv, regression),
        colour=p["colour"],
        embedding=sigmoid(p["embedding"]),
        in_front=in_front,
    )
