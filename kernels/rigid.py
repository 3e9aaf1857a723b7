"""Rigid motion of the map's rows: they follow the keyframes that they come from when those are corrected."""

import taichi as ti

F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
I2 = ti.types.ndarray(dtype=ti.i32, ndim=2)


@ti.kernel
def move_rows(
    rows: ti.i32,
    carriers: I2,  # [N, S] indices of each row's motions, of which it takes the mean
    rotation: F2,  # [K, 4] unit quaternions wxyz
    matrix: F2,  # [K, 12] the same motions as matrices, row by row [R | t]; m
    mean: F2,  # [N, 3] m, changed
    quat_wxyz: F2,  # [N, 4] changed: rotation * quat, of the same norm
):
    """x <- mean of R x + t for the centres, and the axes turn by the normalised sum of the quaternions."""
    for i in range(rows):
        x = ti.Vector([mean[i, 0], mean[i, 1], mean[i, 2]])
        moved = ti.Vector([0.0, 0.0, 0.0])
        turn = ti.Vector([0.0, 0.0, 0.0, 0.0])
        for s in range(carriers.shape[1]):
            k = carriers[i, s]
            for r in ti.static(range(3)):
                moved[r] += (
                    matrix[k, 4 * r] * x[0] + matrix[k, 4 * r + 1] * x[1] + matrix[k, 4 * r + 2] * x[2]
                    + matrix[k, 4 * r + 3]
                )  # fmt: skip
            q = ti.Vector([rotation[k, 0], rotation[k, 1], rotation[k, 2], rotation[k, 3]])
            turn += ti.select(turn.dot(q) < 0.0, -q, q)  # q and -q are one rotation
        moved /= carriers.shape[1]
        for r in ti.static(range(3)):
            mean[i, r] = moved[r]
        turn /= turn.norm()
        w, a, b, c = turn[0], turn[1], turn[2], turn[3]
        qw, qa, qb, qc = quat_wxyz[i, 0], quat_wxyz[i, 1], quat_wxyz[i, 2], quat_wxyz[i, 3]
        quat_wxyz[i, 0] = w * qw - a * qa - b * qb - c * qc
        quat_wxyz[i, 1] = w * qa + a * qw + b * qc - c * qb
        quat_wxyz[i, 2] = w * qb + b * qw + c * qa - a * qc
        quat_wxyz[i, 3] = w * qc + c * qw + a * qb - b * qa
