"""Rigid motions in float64. Tangent vectors are (rotation, translation), applied on the left: T <- exp(xi) T."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
_SMALL = 1e-8
_ROUNDED = 1e-3  # largest entry of R^T R - I of a rotation that was printed with few digits


def hat(vector: ArrayLike) -> Array:
    """[3] -> the skew matrix [3, 3] with hat(a) @ b = a x b."""
    x, y, z = np.asarray(vector, np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def so3_exp(omega: ArrayLike) -> Array:
    """Rotation vector [3] in rad -> rotation matrix [3, 3] (Rodrigues)."""
    omega = np.asarray(omega, np.float64)
    angle = float(np.linalg.norm(omega))
    W = hat(omega)
    if angle < _SMALL:
        return np.eye(3) + W + 0.5 * W @ W
    return np.eye(3) + np.sin(angle) / angle * W + (1.0 - np.cos(angle)) / angle**2 * W @ W


def so3_log(R: ArrayLike) -> Array:
    """Rotation matrix [3, 3] -> rotation vector [3] in rad, angle in [0, pi]."""
    R = np.asarray(R, np.float64)
    quat = quat_wxyz_from_matrix(R)
    vector, w = quat[1:], quat[0]
    length = float(np.linalg.norm(vector))
    if length < _SMALL:
        return 2.0 * vector
    return 2.0 * np.arctan2(length, w) / length * vector


def _left_jacobian(omega: Array) -> Array:
    angle = float(np.linalg.norm(omega))
    W = hat(omega)
    if angle < 1e-5:
        return np.eye(3) + 0.5 * W + W @ W / 6.0
    return np.eye(3) + (1.0 - np.cos(angle)) / angle**2 * W + (angle - np.sin(angle)) / angle**3 * W @ W


def se3_exp(xi: ArrayLike) -> Array:
    """Twist [6] = (rotation rad, translation m) -> transform [4, 4]."""
    xi = np.asarray(xi, np.float64)
    T = np.eye(4)
    T[:3, :3] = so3_exp(xi[:3])
    T[:3, 3] = _left_jacobian(xi[:3]) @ xi[3:]
    return T


def se3_log(T: ArrayLike) -> Array:
    """Transform [4, 4] -> twist [6] = (rotation rad, translation m), the inverse of `se3_exp` for angles below pi."""
    T = np.asarray(T, np.float64)
    omega = so3_log(T[:3, :3])
    return np.concatenate([omega, np.linalg.solve(_left_jacobian(omega), T[:3, 3])])


def inverse(T: ArrayLike) -> Array:
    """Inverse of one rigid transform [4, 4] or a stack [..., 4, 4]."""
    T = np.asarray(T, np.float64)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    result = np.zeros_like(T)
    result[..., :3, :3] = Rt
    result[..., :3, 3] = -(Rt @ T[..., :3, 3:])[..., 0]
    result[..., 3, 3] = 1.0
    return result


def is_motion(T: ArrayLike) -> bool:
    """Whether [4, 4] is a rigid motion, but for rounding: finite, a rotation, no mirror, last row 0 0 0 1."""
    T = np.asarray(T, np.float64)
    if not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    turned = bool(np.abs(R.T @ R - np.eye(3)).max() < _ROUNDED) and float(np.linalg.det(R)) > 0.0
    return turned and bool(np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0)))


def orthonormalized(T: ArrayLike) -> Array:
    """The nearest rigid transform to [4, 4]: removes the rounding that many products leave in the rotation."""
    T = np.array(T, np.float64)
    U, _, Vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    T[3] = [0.0, 0.0, 0.0, 1.0]
    return T


def quat_wxyz_from_matrix(R: ArrayLike) -> Array:
    """Rotation matrix [3, 3] -> unit quaternion wxyz [4] with w >= 0."""
    return quat_wxyz_from_matrices(np.asarray(R, np.float64)[None])[0]


def quat_wxyz_from_matrices(R: ArrayLike) -> Array:
    """Rotation matrices [N, 3, 3] -> unit quaternions wxyz [N, 4] with w >= 0 (Shepperd: by the largest component)."""
    R = np.asarray(R, np.float64)
    m = {(i, j): R[:, i, j] for i in range(3) for j in range(3)}
    candidates = np.stack(
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )  # [4 candidates, 4 components, N]: each is the quaternion times four times one of its components
    best = np.argmax(np.einsum("iin->in", candidates), axis=0)
    quat = candidates[best, :, np.arange(len(R))]
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.where(quat[:, :1] < 0, -quat, quat)


def adjoint(T: ArrayLike) -> Array:
    """[6, 6] with exp(adjoint(T) xi) = T exp(xi) T^-1, for twists (rotation, translation)."""
    T = np.asarray(T, np.float64)
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = T[:3, :3]
    result[3:, :3] = hat(T[:3, 3]) @ T[:3, :3]
    return result


def matrix_from_quat_wxyz(quat_wxyz: ArrayLike) -> Array:
    """Quaternions wxyz [..., 4] (any length but zero) -> rotation matrices [..., 3, 3]."""
    q = np.asarray(quat_wxyz, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quat_product_wxyz(a: ArrayLike, b: ArrayLike) -> Array:
    """Quaternion products [..., 4]: the rotation b, then a."""
    aw, av = np.asarray(a, np.float64)[..., :1], np.asarray(a, np.float64)[..., 1:]
    bw, bv = np.asarray(b, np.float64)[..., :1], np.asarray(b, np.float64)[..., 1:]
    scalar = aw * bw - np.sum(av * bv, -1, keepdims=True)
    return np.concatenate([scalar, aw * bv + bw * av + np.cross(av, bv)], -1)


def transform_points(T_ab: ArrayLike, points_b: ArrayLike) -> Array:
    """Map points [..., 3] m from frame b to frame a."""
    T = np.asarray(T_ab, np.float64)
    return np.asarray(points_b, np.float64) @ T[:3, :3].T + T[:3, 3]


def rotate_rows(R_ab: Array, rows_b: Array) -> Array:
    """Many vectors, as their rows x, y, z [3, N], turned from frame b to frame a.

    Not by BLAS: for a matrix this small, its threads take more time than they save.
    """
    x, y, z = rows_b
    return np.stack([x * a + y * b + z * c for a, b, c in R_ab])


def tangent_axes(normal: Array) -> Array:
    """Unit tangents [..., 2, 3] of unit normals [..., 3], right-handed with them: what planes' covariances speak of."""
    helper = np.eye(3)[np.argmin(np.abs(normal), axis=-1)]
    first = np.cross(helper, normal)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(normal, first)], axis=-2)
