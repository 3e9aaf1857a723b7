"""Gradient of the projection: from the moments of the splats to the Gaussians' parameters and the pose.

The functions take scalars and Lanes alike, as those of `projection` do.
"""

import taichi as ti

from tgslam.kernels.projection import (
    BLUR,
    BLUR_DEPTH,
    EMBEDDING,
    M_0,
    M_CURVATURE_COLOUR,
    M_CURVATURE_DEPTH,
    M_DEPTH,
    M_DEPTH_X,
    M_DEPTH_Y,
    M_EMBEDDING,
    M_RED,
    M_SLOPE,
    M_X,
    M_XX,
    M_XY,
    M_Y,
    M_YY,
    NEAR_M,
    axes_in_camera,
    cross,
    dot,
    in_camera,
    in_view,
    inverse_determinant,
    inverse_norm,
    mixed,
    row,
    rows,
    scaled,
    shapes,
    sigmoid,
)
from tgslam.kernels.simd import LANES, exponential, lanes_kernel
from tgslam.kernels.warp import WARP, warp_sum

nd = ti.types.ndarray
POSE_BLOCK = WARP  # Gaussians whose pose gradients one writer sums
OWN = 11  # gradients of a Gaussian that come from its shape: mean, log-scale, quaternion, opacity logit


@ti.func
def jacobian_gradient(g, focal, ratio, limited, inv_z):
    """Gradients by x (or y) and by z of the Jacobian entry -limited focal / z, times g (constant where limited)."""
    by_x = 0.0 - g * focal * inv_z * inv_z
    by_z = 0.0 - by_x * limited
    free = ratio == limited
    return ti.select(free, by_x, 0.0), ti.select(free, by_z + by_z, by_z)


@ti.func
def quat_gradient(q: ti.template(), torque: ti.template()):
    """2 q (0, torque): gradient by a unit quaternion, given that by a small turn about the Gaussian's own axes."""
    w, x, y, z = q[0] + q[0], q[1] + q[1], q[2] + q[2], q[3] + q[3]
    return [
        0.0 - (x * torque[0] + y * torque[1] + z * torque[2]),
        w * torque[0] + y * torque[2] - z * torque[1],
        w * torque[1] + z * torque[0] - x * torque[2],
        w * torque[2] + x * torque[1] - y * torque[0],
    ]


@ti.func
def ellipse_gradient(ax, ay, mz, g: ti.template()):
    """Gradients by the rows of A = J M and by mz, the z row of M, and by the centre in px; by half the log-scales.

    With the inverse covariance Q, B = Q A and D = P A (Q with BLUR, P with BLUR_DEPTH) and the part of mz that the
    depth slopes D mz leave, no term of a long splat is the small difference of large ones:
    dQ = -Q dA B^T - B dA^T Q, d(slope) = P dA rest - D dA^T slope + D dmz
    """
    normal = cross(ax, ay)
    to_x, to_y = cross(ay, normal), cross(normal, ax)  # B is small where A is large: no differences here either
    area, xx, xy, yy = dot(normal, normal), dot(ax, ax), dot(ax, ay), dot(ay, ay)
    inv_det = inverse_determinant(area, xx, yy, BLUR)
    inv_depth_det = inverse_determinant(area, xx, yy, BLUR_DEPTH)
    qxx, qxy, qyy = (yy + BLUR) * inv_det, (0.0 - xy) * inv_det, (xx + BLUR) * inv_det
    bx, by = mixed(inv_det, to_x, BLUR * inv_det, ax), mixed(inv_det, to_y, BLUR * inv_det, ay)
    blur = BLUR_DEPTH * inv_depth_det
    dx, dy = mixed(inv_depth_det, to_x, blur, ax), mixed(inv_depth_det, to_y, blur, ay)
    zu, zv = dot(mz, dx), dot(mz, dy)
    rest = [mz[k] - zu * ax[k] - zv * ay[k] for k in ti.static(range(3))]
    gxx, gxy, gyy = -0.5 * g[M_XX], -0.5 * g[M_XY], -0.5 * g[M_YY]
    gbx, gby = mixed(gxx, bx, gxy, by), mixed(gxy, bx, gyy, by)
    gzu, gzv = g[M_DEPTH_X], g[M_DEPTH_Y]
    gmz = mixed(gzu, dx, gzv, dy)
    by_x = ((yy + BLUR_DEPTH) * gzu - xy * gzv) * inv_depth_det
    by_y = ((xx + BLUR_DEPTH) * gzv - xy * gzu) * inv_depth_det
    gax = [by_x * rest[k] - zu * gmz[k] - 2.0 * (qxx * gbx[k] + qxy * gby[k]) for k in ti.static(range(3))]
    gay = [by_y * rest[k] - zv * gmz[k] - 2.0 * (qxy * gbx[k] + qyy * gby[k]) for k in ti.static(range(3))]
    gu = qxx * g[M_X] + qxy * g[M_Y] - zu * g[M_SLOPE]
    gv = qxy * g[M_X] + qyy * g[M_Y] - zv * g[M_SLOPE]
    # A's column k times its own gradient, and mz's, with what cancels left out
    gs = [gmz[k] * rest[k] - gbx[k] * bx[k] - gby[k] * by[k] for k in ti.static(range(3))]
    return gax, gay, gmz, gu, gv, gs


@ti.func
def gaussian_gradient(
    mean,
    log_scale,
    quat,
    opacity_logit,
    g,  # moments, of which those up to M_SLOPE are used
    pose: ti.template(),
    camera: ti.template(),
    width,
    height,
):
    """Gradients of a Gaussian's mean, log-scale, quaternion and opacity logit in a list, and its part of the pose's."""
    fx, fy = camera[0], camera[1]
    point = in_camera(pose, mean)
    inv_norm = inverse_norm(quat)
    q = [quat[k] * inv_norm for k in ti.static(range(4))]
    axes = axes_in_camera(pose, q)
    s = [exponential(log_scale[k]) for k in ti.static(range(3))]
    inv_z = 1.0 / ti.max(point[2], NEAR_M)
    x, y = point[0] * inv_z, point[1] * inv_z
    tx, ty = in_view(x, camera[2], fx, width), in_view(y, camera[3], fy, height)
    j0, j1 = fx * inv_z, fy * inv_z
    unit_x, unit_y = mixed(j0, axes[0], 0.0 - j0 * tx, axes[2]), mixed(j1, axes[1], 0.0 - j1 * ty, axes[2])
    gax, gay, gmz, gu, gv, gs = ellipse_gradient(scaled(s, unit_x), scaled(s, unit_y), scaled(s, axes[2]), g)
    # A turn about the Gaussian's own axes: the lengths of the axes themselves do not come in
    to_x, to_y, to_z = scaled(s, gax), scaled(s, gay), scaled(s, gmz)
    torque_x, torque_y, torque_z = cross(to_x, unit_x), cross(to_y, unit_y), cross(to_z, axes[2])
    torque = [torque_x[k] + torque_y[k] + torque_z[k] for k in ti.static(range(3))]
    # Rows of A = J M -> J -> the centre in the camera's frame
    jx_by_x, jx_by_z = jacobian_gradient(dot(to_x, axes[2]), fx, x, tx, inv_z)
    jy_by_y, jy_by_z = jacobian_gradient(dot(to_y, axes[2]), fy, y, ty, inv_z)
    gz = g[M_DEPTH] - inv_z * (j0 * dot(to_x, axes[0]) + j1 * dot(to_y, axes[1]) + gu * fx * x + gv * fy * y)
    gp = [gu * j0 + jx_by_x, gv * j1 + jy_by_y, gz + jx_by_z + jy_by_z]
    lever = cross(point, gp)
    gq = quat_gradient(q, torque)
    by_mean = [pose[k] * gp[0] + pose[4 + k] * gp[1] + pose[8 + k] * gp[2] for k in ti.static(range(3))]
    by_log_scale = [gs[k] + gs[k] for k in ti.static(range(3))]
    by_quat = [gq[k] * inv_norm for k in ti.static(range(4))]
    # Left perturbation of the pose: dx = w cross x + t, and the axes turn with w
    turn = [lever[r] + dot(axes[r], torque) for r in ti.static(range(3))]
    return by_mean + by_log_scale + by_quat + [g[M_0] * sigmoid(0.0 - opacity_logit)], turn + gp


@ti.func
def any_drawn(first, count, tile_count: ti.template()):
    """Whether any of LANES Gaussians touches a tile."""
    tiles = 0
    for i in range(first, ti.min(first + LANES, count)):
        tiles += tile_count[i]
    return tiles > 0


@ti.func
def gradients_of_16(
    first,
    count,
    mean: ti.template(),
    log_scale: ti.template(),
    quat: ti.template(),
    opacity_logit: ti.template(),
    moments: ti.template(),
    pose: ti.template(),
    camera: ti.template(),
    width,
    height,
):
    """`gaussian_gradient` of LANES Gaussians from `first` on."""
    scales, turns, logit = shapes(first, count, log_scale, quat, opacity_logit)
    return gaussian_gradient(
        rows(first, count, mean, 3), scales, turns, logit, rows(first, count, moments, M_SLOPE + 1),
        pose, camera, width, height,
    )  # fmt: skip


@ti.func
def add_gradient(
    i,
    own: ti.template(),  # of `gaussian_gradient`
    splat: ti.template(),
    with_embedding: ti.template(),
    moments: ti.template(),
    grad_mean: ti.template(),
    grad_log_scale: ti.template(),
    grad_quat: ti.template(),
    grad_opacity_logit: ti.template(),
    grad_colour: ti.template(),
    grad_embedding: ti.template(),
    curvature: ti.template(),
):
    """Add a Gaussian's gradients to the arrays, in full, since `+=` on an array element is an atomic addition."""
    for k in ti.static(range(3)):
        grad_mean[i, k] = grad_mean[i, k] + own[k]
        grad_log_scale[i, k] = grad_log_scale[i, k] + own[3 + k]
        grad_colour[i, k] = grad_colour[i, k] + moments[i, M_RED + k]
        if ti.static(with_embedding):
            e = splat[i, EMBEDDING + k]
            grad_embedding[i, k] = grad_embedding[i, k] + moments[i, M_EMBEDDING + k] * e * (1.0 - e)
    for k in ti.static(range(4)):
        grad_quat[i, k] = grad_quat[i, k] + own[6 + k]
    grad_opacity_logit[i] = grad_opacity_logit[i] + own[10]
    curvature[i, 0] = curvature[i, 0] + moments[i, M_CURVATURE_COLOUR]
    curvature[i, 1] = curvature[i, 1] + moments[i, M_CURVATURE_DEPTH]


@lanes_kernel
def project_backward(
    count: ti.i32,
    mean: nd(ti.f32, ndim=2),  # [N, 3] m, world
    log_scale: nd(ti.f32, ndim=2),  # [N, 3] log m
    quat: nd(ti.f32, ndim=2),  # [N, 4] wxyz
    opacity_logit: nd(ti.f32, ndim=1),  # [N]
    splat: nd(ti.f32, ndim=2),  # [N, SPLAT] of `project`, read for the embedding's logistic function
    pose: nd(ti.f32, ndim=1),  # [12] T_cw
    camera: nd(ti.f32, ndim=1),  # [4] fx, fy, cx, cy px
    width: ti.i32,
    height: ti.i32,
    with_embedding: ti.template(),
    tile_count: nd(ti.i32, ndim=1),  # [N] 0 = not rendered
    moments: nd(ti.f32, ndim=2),  # [N, MOMENTS or more]
    grad_mean: nd(ti.f32, ndim=2),  # [N, 3] added to, as are all outputs but the pose's
    grad_log_scale: nd(ti.f32, ndim=2),  # [N, 3]
    grad_quat: nd(ti.f32, ndim=2),  # [N, 4]
    grad_opacity_logit: nd(ti.f32, ndim=1),  # [N]
    grad_colour: nd(ti.f32, ndim=2),  # [N, 3]
    grad_embedding: nd(ti.f32, ndim=2),  # [N, 3]
    curvature: nd(ti.f32, ndim=2),  # [N, 2] summed residual weights: colour, depth
    grad_pose: nd(ti.f32, ndim=2),  # [blocks, 6] (rotation, translation), left perturbation of T_cw, a row a block
):
    """Moments of the splats -> gradients of the Gaussians' parameters and of the pose.

    A row of the pose's gradient is summed by one thread on the CPU, by one warp under CUDA, in a fixed order.
    """
    w, h = ti.cast(width, ti.f32), ti.cast(height, ti.f32)
    if ti.static(ti.cfg.arch == ti.cuda):
        ti.loop_config(block_dim=128)  # a Gaussian takes many registers
        for i in range(grad_pose.shape[0] * POSE_BLOCK):
            part = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
            if i < count:
                if tile_count[i] > 0:
                    own, pose_part = gaussian_gradient(
                        row(i, mean, 3), row(i, log_scale, 3), row(i, quat, 4), opacity_logit[i],
                        row(i, moments, M_SLOPE + 1), pose, camera, w, h,
                    )  # fmt: skip
                    for c in ti.static(range(6)):
                        part[c] = pose_part[c]
                    add_gradient(
                        i, own, splat, with_embedding, moments, grad_mean, grad_log_scale, grad_quat,
                        grad_opacity_logit, grad_colour, grad_embedding, curvature,
                    )  # fmt: skip
            for c in ti.static(range(6)):
                total = warp_sum(part[c])
                if i % POSE_BLOCK == c:
                    grad_pose[i // POSE_BLOCK, c] = total
    else:
        for block in range(grad_pose.shape[0]):
            total = [0.0 for c in ti.static(range(6))]
            for part in range(POSE_BLOCK // LANES):
                first = block * POSE_BLOCK + part * LANES
                if any_drawn(first, count, tile_count):
                    own, pose_part = gradients_of_16(
                        first, count, mean, log_scale, quat, opacity_logit, moments, pose, camera, w, h
                    )
                    for i in range(first, ti.min(first + LANES, count)):
                        if tile_count[i] > 0:
                            for c in ti.static(range(6)):
                                total[c] += pose_part[c][i - first]
                            add_gradient(
                                i, [own[c][i - first] for c in ti.static(range(OWN))], splat, with_embedding,
                                moments, grad_mean, grad_log_scale, grad_quat, grad_opacity_logit, grad_colour,
                                grad_embedding, curvature,
                            )  # fmt: skip
            for c in ti.static(range(6)):
                grad_pose[block, c] = total[c]
