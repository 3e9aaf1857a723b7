"""What keeps the Gaussians of a plane flat, aligned and on it: Eqs. 8 and 9 and the distance, each a mean over them.

A Gaussian is planar if its plane has a row in the table with a normal, and it takes part if it is visible. Both
kernels go over blocks of Gaussians, a block a thread on the CPU and a warp under CUDA.
"""

import taichi as ti

from tgslam.kernels.objective import share
from tgslam.kernels.projection import rotation_from_quat
from tgslam.kernels.simd import exp_neg
from tgslam.kernels.warp import WARP, warp_sum

F1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
I1 = ti.types.ndarray(dtype=ti.i32, ndim=1)
vec4 = ti.types.vector(4, ti.f32)

BLOCK = WARP
COUNT, FLAT, NORMAL, DISTANCE = range(4)  # sums over the planar Gaussians in sight
TOTALS = 4


@ti.func
def is_planar(i, count, visible: ti.template(), plane_id: ti.template(), plane: ti.template()):
    """1 if Gaussian i exists, is visible and lies on a plane, else 0."""
    planar = 0
    if i < count:
        at = plane_id[i]
        if visible[i] != 0 and at >= 0 and at < plane.shape[0]:
            planar = ti.cast(plane[at, 0] != 0.0 or plane[at, 1] != 0.0 or plane[at, 2] != 0.0, ti.i32)
    return planar


@ti.func
def regularise_one(
    i,
    plane_id: ti.template(),
    plane: ti.template(),
    mean: ti.template(),
    log_scale: ti.template(),
    quat: ti.template(),
    weights,
    thinness,
    per_sigma,
    grad_mean: ti.template(),
    grad_log_scale: ti.template(),
    grad_quat: ti.template(),
):
    """Add one Gaussian's gradients; returns its three penalties. weights: of the three, already over the count."""
    at = plane_id[i]
    normal = ti.Vector([plane[at, 0], plane[at, 1], plane[at, 2]])
    # Flatness
    logs = ti.Vector([log_scale[i, 0], log_scale[i, 1], log_scale[i, 2]])
    minor = ti.select(logs[1] < logs[0], 1, 0)
    minor = ti.select(logs[2] < ti.min(logs[0], logs[1]), 2, minor)
    least = ti.min(logs[0], ti.min(logs[1], logs[2]))
    ratio = exp_neg(0.5 * logs.sum() - 1.5 * least)  # s3 / sqrt(s1 s2); below 1/255 it is constant
    off = ratio - thinness
    for k in ti.static(range(3)):
        by_log = off * ti.select(minor == k, 2.0 * ratio, -thinness)
        grad_log_scale[i, k] = grad_log_scale[i, k] + weights[0] * by_log
    # Alignment: turning by a small t changes the quaternion q by t q / 2
    raw = ti.Vector([quat[i, 0], quat[i, 1], quat[i, 2], quat[i, 3]])
    inv_norm = 1.0 / raw.norm()
    q = raw * inv_norm
    R = rotation_from_quat(q[0], q[1], q[2], q[3])
    axis = ti.Vector([ti.select(minor == 0, R[r, 0], ti.select(minor == 1, R[r, 1], R[r, 2])) for r in range(3)])
    cosine = axis.dot(normal)
    turn = (2.0 * inv_norm * weights[1] * ti.select(cosine < 0.0, -1.0, 1.0)) * normal.cross(axis)
    of_q = ti.Vector([q[1], q[2], q[3]])
    by_vector = q[0] * turn + turn.cross(of_q)
    grad_quat[i, 0] = grad_quat[i, 0] - turn.dot(of_q)
    for c in ti.static(range(3)):
        grad_quat[i, 1 + c] = grad_quat[i, 1 + c] + by_vector[c]
    # Distance: what is far off lies on another surface, next to the plane, and is left there
    height = per_sigma * (normal.dot(ti.Vector([mean[i, 0], mean[i, 1], mean[i, 2]])) + plane[at, 3])
    bound = 1.0 + height * height
    by_height = weights[2] * per_sigma * height / (bound * bound)
    for c in ti.static(range(3)):
        grad_mean[i, c] = grad_mean[i, c] + by_height * normal[c]
    return vec4(0.0, off * off, 1.0 - ti.abs(cosine), 0.5 * height * height / bound)


@ti.kernel
def count_planar(
    count: ti.i32,
    visible: I1,  # [N] 0 = not in sight
    plane_id: I1,  # [N] row of `plane`; none where there is no such row
    plane: F2,  # [P, 4] unit normal and offset in m of n . x + d = 0, world; all 0 = no plane
    partial: F2,  # [TOTALS, blocks] out
):
    """How many Gaussians take part."""
    if ti.static(ti.cfg.arch == ti.cuda):
        for i in range(partial.shape[1] * BLOCK):
            total = warp_sum(ti.cast(is_planar(i, count, visible, plane_id, plane), ti.f32))
            if i % WARP == 0:
                partial[COUNT, i // WARP] = total
                for c in ti.static(range(1, TOTALS)):
                    partial[c, i // WARP] = 0.0
    else:
        for block in range(partial.shape[1]):
            total = 0.0
            for i in range(block * BLOCK, (block + 1) * BLOCK):
                total += ti.cast(is_planar(i, count, visible, plane_id, plane), ti.f32)
            partial[COUNT, block] = total
            for c in ti.static(range(1, TOTALS)):
                partial[c, block] = 0.0


@ti.kernel
def regularise(
    count: ti.i32,
    visible: I1,  # [N] 0 = not in sight
    plane_id: I1,  # [N]
    plane: F2,  # [P, 4]
    mean: F2,  # [N, 3] m, world
    log_scale: F2,  # [N, 3] log m
    quat: F2,  # [N, 4] wxyz
    weight_flat: ti.f32,
    weight_normal: ti.f32,
    weight_distance: ti.f32,
    thinness: ti.f32,  # k of Eq. 8
    sigma_m: ti.f32,  # unit of the distance
    counted: F1,  # [TOTALS] of which COUNT is read
    grad_mean: F2,  # [N, 3] added to, as are the next two
    grad_log_scale: F2,  # [N, 3]
    grad_quat: F2,  # [N, 4]
    partial: F2,  # [TOTALS, blocks] out: the count again, and the sums of the three penalties
):
    """Penalties and gradients.

    Eq. 8 is divided by s1 s2, which counts as a constant: its gradient by the logarithm of a scale would otherwise grow
    with the square of the Gaussian's size, and it would flatten nothing but the largest ones.
    """
    if ti.static(ti.cfg.arch == ti.cuda):
        for i in range(partial.shape[1] * BLOCK):
            part = vec4(0.0)
            if is_planar(i, count, visible, plane_id, plane) != 0:
                each = share(1.0, counted[COUNT])
                part = regularise_one(
                    i, plane_id, plane, mean, log_scale, quat,
                    each * ti.Vector([weight_flat, weight_normal, weight_distance]), thinness, 1.0 / sigma_m,
                    grad_mean, grad_log_scale, grad_quat,
                )  # fmt: skip
                part[COUNT] = 1.0
            for c in ti.static(range(TOTALS)):
                total = warp_sum(part[c])
                if i % WARP == 0:
                    partial[c, i // WARP] = total
    else:
        for block in range(partial.shape[1]):
            total = vec4(0.0)
            for i in range(block * BLOCK, (block + 1) * BLOCK):
                if is_planar(i, count, visible, plane_id, plane) != 0:
                    each = share(1.0, counted[COUNT])
                    total += regularise_one(
                        i, plane_id, plane, mean, log_scale, quat,
                        each * ti.Vector([weight_flat, weight_normal, weight_distance]), thinness, 1.0 / sigma_m,
                        grad_mean, grad_log_scale, grad_quat,
                    )  # fmt: skip
                    total[COUNT] += 1.0
            for c in ti.static(range(TOTALS)):
                partial[c, block] = total[c]
