"""Rigid motion of the map's rows: what a keyframe has contributed follows it when its pose is corrected."""

import taichi as ti

F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
I1 = ti.types.ndarray(dtype=ti.i32, ndim=1)


@ti.kernel
def move_rows(
    rows: ti.i32,
    birth: I1,  # [N] index of each row's motion
    rotation: F2,  # [K, 4] unit quaternions wxyz
    matrix: F2,  # [K, 12] the same motions as matrices, row by row [R | t]; m
    mean: F2,  # [N, 3] m, changed
    quat_wxyz: F2,  # [N, 4] changed: rotation * quat, of the same norm
):
    """x <- R x + t for the centres, and the axes turn by R."""
    for i in range(rows):
        k = birth[i]
        x, y, z = mean[i, 0], mean[i, 1], mean[i, 2]
        for r in ti.static(range(3)):
            mean[i, r] = (
                matrix[k, 4 * r] * x + matrix[k, 4 * r + 1] * y + matrix[k, 4 * r + 2] * z + matrix[k, 4 * r + 3]
            )
        w, a, b, c = rotation[k, 0], rotation[k, 1], rotation[k, 2], rotation[k, 3]
        qw, qa, qb, qc = quat_wxyz[i, 0], quat_wxyz[i, 1], quat_wxyz[i, 2], quat_wxyz[i, 3]
        quat_wxyz[i, 0] = w * qw - a * qa - b * qb - c * qc
        quat_wxyz[i, 1] = w * qa + a * qw + b * qc - c * qb
        quat_wxyz[i, 2] = w * qb + b * qw + c * qa - a * qc
        quat_wxyz[i, 3] = w * qc + c * qw + a * qb - b * qa
