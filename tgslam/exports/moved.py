"""What a run has found, seen from another world frame; NumPy only."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from tgslam.geometry import quat_product_wxyz, quat_wxyz_from_matrix, tangent_axes
from tgslam.types import Gaussians, Matrix4, Plane, Trajectory


def moved_gaussians(gaussians: Gaussians, T: Matrix4) -> Gaussians:
    """The Gaussians of a frame w in the frame l, with T [4, 4] = T_lw; the quaternions come out of unit length."""
    quat = gaussians.quat_wxyz.astype(np.float64)
    turned = quat_product_wxyz(quat_wxyz_from_matrix(T[:3, :3]), quat / np.linalg.norm(quat, axis=1, keepdims=True))
    mean = gaussians.mean.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    return dataclasses.replace(gaussians, mean=mean.astype(np.float32), quat_wxyz=turned.astype(np.float32))


def moved_trajectory(trajectory: Trajectory, T: Matrix4) -> Trajectory:
    """The poses T_wc as T_lc, with T [4, 4] = T_lw."""
    return Trajectory(trajectory.timestamps_s, np.asarray(T @ trajectory.T_wc))


def moved_planes(planes: Sequence[Plane], T: Matrix4) -> tuple[Plane, ...]:
    """The planes of a frame w in the frame l, with T [4, 4] = T_lw."""
    return tuple(_moved_plane(plane, T) for plane in planes)


def _moved_plane(plane: Plane, T: Matrix4) -> Plane:
    R, t = T[:3, :3], T[:3, 3]
    normal = R @ plane.normal_w
    to_new = np.eye(3)  # the covariance is about tangents that follow from the normal alone
    to_new[:2, :2] = tangent_axes(normal) @ R @ tangent_axes(plane.normal_w).T
    return dataclasses.replace(
        plane,
        normal_w=normal,
        offset_m=plane.offset_m - float(normal @ t),
        centroid_w=R @ plane.centroid_w + t,
        covariance=to_new @ plane.covariance @ to_new.T,
        polygons_w=tuple(polygon @ R.T + t for polygon in plane.polygons_w),
    )
