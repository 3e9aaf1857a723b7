"""Projection of 3D Gaussians to screen-space splats, and its gradient.

A splat is what the rasterizer needs of a Gaussian: centre, inverse covariance, opacity, tangent-plane depth, colour.
Columns of a splat row, and of the moments that the rasterizer's backward pass sums for it, are the constants below.
"""

import taichi as ti

from tgslam.kernels.cuda.warp import WARP, warp_sum
from tgslam.kernels.simd import REACH, TILE

nd = ti.types.ndarray
mat3 = ti.types.matrix(3, 3, ti.f32)
mat23 = ti.types.matrix(2, 3, ti.f32)

U, V, QA, QB, QC, FADE, Z, ZU, ZV, RED, EMBEDDING, INV_Z = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 12, 15
SPLAT = 16  # columns of a splat row: centre px, half the inverse covariance, -ln(opacity), depth and its slope, colours
# Sums over pixels; h = alpha dL/dalpha, w = blend weight, (x, y) = offset from the centre, s = first-order depth step
M_0, M_X, M_Y, M_XX, M_XY, M_YY = 0, 1, 2, 3, 4, 5  # h, h x, h y, h x^2, h x y, h y^2
M_DEPTH, M_DEPTH_X, M_DEPTH_Y, M_SLOPE = 6, 7, 8, 9  # of w dL/ddepth: (1 - s^2/z^2), (1 + 2s/z) x, same y, same
M_RED, M_CURVATURE_COLOUR, M_CURVATURE_DEPTH, M_EMBEDDING = 10, 13, 14, 16  # w times the pixel's gradient or weight
MOMENTS = 20

BLUR_DEPTH = 0.03  # px^2 in the regression of depth on the pixel: BLUR would flatten the depth slope of small splats
BLUR = 0.3  # px^2 added to the screen covariance, the 3DGS standard's low-pass filter
NEAR_M = 0.05
EDGE = 1.3  # the Jacobian is evaluated at most this many half-images off the axis
POSE_BLOCK = WARP  # Gaussians whose pose gradients one writer sums


@ti.func
def sigmoid(x):
    """Logistic function, stable for both signs."""
    e = ti.exp(-ti.abs(x))
    return ti.select(x >= 0, 1.0 / (1.0 + e), e / (1.0 + e))


@ti.func
def rotation_from_quat(w, x, y, z):
    """Unit quaternion -> rotation matrix."""
    return mat3(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    )


@ti.func
def rotation_of_pose(pose: ti.template()):
    """The rotation of T_cw, stored row by row as [R | t]."""
    return mat3([pose[0], pose[1], pose[2]], [pose[4], pose[5], pose[6]], [pose[8], pose[9], pose[10]])


@ti.func
def clamped(ratio, centre, focal, size):
    """x/z (or y/z) limited to EDGE half-images, so that the linearisation stays sane beside the camera."""
    low = (-0.5 * (EDGE - 1.0) * size - centre) / focal
    high = ((1.0 + 0.5 * (EDGE - 1.0)) * size - centre) / focal
    return ti.min(ti.max(ratio, low), high)


@ti.func
def blurred_determinant(ax: ti.template(), ay: ti.template(), blur):
    """det of the screen covariance A A^T + blur I, by Lagrange's identity for det(A A^T).

    cxx cyy - cxy^2 cancels to nothing in float32 for a long thin splat across the pixel grid; this sums positive terms.
    """
    return ax.cross(ay).norm_sqr() + blur * (ax.norm_sqr() + ay.norm_sqr() + blur)


@ti.func
def precision_times_rows(ax: ti.template(), ay: ti.template(), blur):
    """B = (A A^T + blur I)^-1 A, with the triple product since, for the reason above, B is small where A is large."""
    n = ax.cross(ay)
    inv_det = 1.0 / blurred_determinant(ax, ay, blur)
    return (ay.cross(n) + blur * ax) * inv_det, (n.cross(ax) + blur * ay) * inv_det


@ti.func
def axes_in_camera(R: ti.template(), Rq: ti.template(), s: ti.template()):
    """M = R Rq diag(s): the Gaussian's axes in the camera frame, as long as its standard deviations."""
    M = R @ Rq
    for k in ti.static(range(3)):
        for r in ti.static(range(3)):
            M[r, k] *= s[k]
    return M


@ti.func
def quat_gradient(H: ti.template(), q: ti.template()):
    """Gradient by the unit quaternion q, given that by its rotation matrix."""
    w, a, b, c = q[0], q[1], q[2], q[3]
    skew = ti.Vector([H[2, 1] - H[1, 2], H[0, 2] - H[2, 0], H[1, 0] - H[0, 1]])
    ab, ac, bc = H[0, 1] + H[1, 0], H[0, 2] + H[2, 0], H[1, 2] + H[2, 1]
    return 2.0 * ti.Vector(
        [
            a * skew[0] + b * skew[1] + c * skew[2],
            w * skew[0] + b * ab + c * ac - 2.0 * a * (H[1, 1] + H[2, 2]),
            w * skew[1] + a * ab + c * bc - 2.0 * b * (H[0, 0] + H[2, 2]),
            w * skew[2] + a * ac + b * bc - 2.0 * c * (H[0, 0] + H[1, 1]),
        ]
    )


@ti.func
def jacobian_gradient(g, focal, ratio, limited, inv_z2):
    """Gradients by x (or y) and by z of the Jacobian entry -limited focal / z, times g (constant where limited)."""
    by_z = g * focal * limited * inv_z2
    free = ratio == limited
    return ti.select(free, -g * focal * inv_z2, 0.0), ti.select(free, 2.0 * by_z, by_z)


@ti.kernel
def project(
    count: ti.i32,
    mean: nd(ti.f32, ndim=2),  # [N, 3] m, world
    log_scale: nd(ti.f32, ndim=2),  # [N, 3] log m
    quat: nd(ti.f32, ndim=2),  # [N, 4] wxyz
    opacity_logit: nd(ti.f32, ndim=1),  # [N]
    colour: nd(ti.f32, ndim=2),  # [N, 3]
    embedding: nd(ti.f32, ndim=2),  # [N, 3] theta
    pose: nd(ti.f32, ndim=1),  # [12] T_cw
    camera: nd(ti.f32, ndim=1),  # [4] fx, fy, cx, cy px
    width: ti.i32,
    height: ti.i32,
    with_embedding: ti.template(),
    splat: nd(ti.f32, ndim=2),  # [N, SPLAT] out
    tile_rect: nd(ti.i32, ndim=2),  # [N, 4] out: first and last tile in x, then in y; empty: first > last
    tile_count: nd(ti.i32, ndim=1),  # [N] out: tiles touched
):
    """Gaussians -> splats and the tiles that their alpha >= 1/255 box touches (Zwicker's EWA, as 3DGS)."""
    for i in range(count):
        R = rotation_of_pose(pose)
        x = R @ ti.Vector([mean[i, 0], mean[i, 1], mean[i, 2]]) + ti.Vector([pose[3], pose[7], pose[11]])
        tile_rect[i, 0], tile_rect[i, 1], tile_rect[i, 2], tile_rect[i, 3] = 0, -1, 0, -1
        tile_count[i] = 0
        if x[2] > NEAR_M:
            fx, fy = camera[0], camera[1]
            q = ti.Vector([quat[i, 0], quat[i, 1], quat[i, 2], quat[i, 3]]).normalized()
            s = ti.Vector([ti.exp(log_scale[i, k]) for k in range(3)])
            M = axes_in_camera(R, rotation_from_quat(q[0], q[1], q[2], q[3]), s)
            inv_z = 1.0 / x[2]
            jx = -clamped(x[0] * inv_z, camera[2], fx, width) * fx * inv_z
            jy = -clamped(x[1] * inv_z, camera[3], fy, height) * fy * inv_z
            ax = ti.Vector([fx * inv_z * M[0, k] + jx * M[2, k] for k in range(3)])
            ay = ti.Vector([fy * inv_z * M[1, k] + jy * M[2, k] for k in range(3)])
            mz = ti.Vector([M[2, 0], M[2, 1], M[2, 2]])
            cxx, cxy, cyy = ax.dot(ax) + BLUR, ax.dot(ay), ay.dot(ay) + BLUR
            inv_det = 1.0 / blurred_determinant(ax, ay, BLUR)
            qxx, qxy, qyy = cyy * inv_det, -cxy * inv_det, cxx * inv_det
            bx, by = precision_times_rows(ax, ay, BLUR_DEPTH)
            u, v = fx * x[0] * inv_z + camera[2], fy * x[1] * inv_z + camera[3]
            fade = ti.log(1.0 + ti.exp(-ti.abs(opacity_logit[i]))) + ti.max(-opacity_logit[i], 0.0)
            splat[i, U], splat[i, V] = u, v
            splat[i, QA], splat[i, QB], splat[i, QC] = 0.5 * qxx, qxy, 0.5 * qyy
            splat[i, FADE], splat[i, Z], splat[i, INV_Z] = fade, x[2], inv_z
            splat[i, ZU], splat[i, ZV] = mz.dot(bx), mz.dot(by)
            for c in ti.static(range(3)):
                splat[i, RED + c] = colour[i, c]
                if ti.static(with_embedding):
                    splat[i, EMBEDDING + c] = sigmoid(embedding[i, c])
            reach = ti.max(2.0 * (REACH - fade), 0.0)  # Mahalanobis^2 where alpha has fallen to ALPHA_MIN
            rx, ry = ti.sqrt(reach * cxx), ti.sqrt(reach * cyy)
            if reach > 0.0 and u + rx >= 0 and u - rx <= width - 1 and v + ry >= 0 and v - ry <= height - 1:
                x0 = ti.cast(ti.max(u - rx, 0.0), ti.i32) // TILE
                x1 = ti.cast(ti.min(u + rx, width - 1.0), ti.i32) // TILE
                y0 = ti.cast(ti.max(v - ry, 0.0), ti.i32) // TILE
                y1 = ti.cast(ti.min(v + ry, height - 1.0), ti.i32) // TILE
                tile_rect[i, 0], tile_rect[i, 1] = x0, x1
                tile_rect[i, 2], tile_rect[i, 3] = y0, y1
                tile_count[i] = (x1 - x0 + 1) * (y1 - y0 + 1)


@ti.func
def gaussian_backward(
    i,
    mean: ti.template(),
    log_scale: ti.template(),
    quat: ti.template(),
    opacity_logit: ti.template(),
    embedding: ti.template(),
    pose: ti.template(),
    camera: ti.template(),
    width,
    height,
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
    """One Gaussian's part of `project_backward`; returns its part of the pose gradient.

    Sums into arrays are written out, since `+=` on an array element is an atomic addition, on the CPU a locked loop.
    """
    # The forward quantities again
    R = rotation_of_pose(pose)
    x = R @ ti.Vector([mean[i, 0], mean[i, 1], mean[i, 2]]) + ti.Vector([pose[3], pose[7], pose[11]])
    fx, fy = camera[0], camera[1]
    raw = ti.Vector([quat[i, 0], quat[i, 1], quat[i, 2], quat[i, 3]])
    inv_norm = 1.0 / raw.norm()
    q = raw * inv_norm
    Rq = rotation_from_quat(q[0], q[1], q[2], q[3])
    s = ti.Vector([ti.exp(log_scale[i, k]) for k in range(3)])
    M = axes_in_camera(R, Rq, s)
    inv_z = 1.0 / x[2]
    rx, ry = x[0] * inv_z, x[1] * inv_z
    tx, ty = clamped(rx, camera[2], fx, width), clamped(ry, camera[3], fy, height)
    j0, j1, jx, jy = fx * inv_z, fy * inv_z, -tx * fx * inv_z, -ty * fy * inv_z
    mz = ti.Vector([M[2, 0], M[2, 1], M[2, 2]])
    ax = ti.Vector([j0 * M[0, k] + jx * M[2, k] for k in range(3)])
    ay = ti.Vector([j1 * M[1, k] + jy * M[2, k] for k in range(3)])
    cxx, cxy, cyy = ax.dot(ax) + BLUR, ax.dot(ay), ay.dot(ay) + BLUR
    inv_det = 1.0 / blurred_determinant(ax, ay, BLUR)
    qxx, qxy, qyy = cyy * inv_det, -cxy * inv_det, cxx * inv_det
    # Inverse covariance Q and depth slopes D mz -> rows of A = J M and the z row of M. With B = Q A and
    # D = P A (Q with BLUR, P with BLUR_DEPTH) and the part of mz that the slopes leave, no term of a long
    # splat is the small difference of large ones:
    # dQ = -Q dA B^T - B dA^T Q, d(slope) = P dA rest - D dA^T slope + D dmz
    bx, by = precision_times_rows(ax, ay, BLUR)
    dx, dy = precision_times_rows(ax, ay, BLUR_DEPTH)
    inv_depth_det = 1.0 / blurred_determinant(ax, ay, BLUR_DEPTH)
    pxx, pxy, pyy = ay.dot(ay) + BLUR_DEPTH, -cxy, ax.dot(ax) + BLUR_DEPTH
    zu, zv = mz.dot(dx), mz.dot(dy)
    rest = mz - zu * ax - zv * ay
    gz, gzu, gzv = moments[i, M_DEPTH], moments[i, M_DEPTH_X], moments[i, M_DEPTH_Y]
    gu = qxx * moments[i, M_X] + qxy * moments[i, M_Y] - zu * moments[i, M_SLOPE]
    gv = qxy * moments[i, M_X] + qyy * moments[i, M_Y] - zv * moments[i, M_SLOPE]
    gxx, gxy, gyy = -0.5 * moments[i, M_XX], -0.5 * moments[i, M_XY], -0.5 * moments[i, M_YY]
    gbx, gby = gxx * bx + gxy * by, gxy * bx + gyy * by
    gmz = gzu * dx + gzv * dy
    gax = (pxx * gzu + pxy * gzv) * inv_depth_det * rest - zu * gmz - 2.0 * (qxx * gbx + qxy * gby)
    gay = (pxy * gzu + pyy * gzv) * inv_depth_det * rest - zv * gmz - 2.0 * (qxy * gbx + qyy * gby)
    # Rows of A = J M -> J and M
    m0 = ti.Vector([M[0, 0], M[0, 1], M[0, 2]])
    m1 = ti.Vector([M[1, 0], M[1, 1], M[1, 2]])
    gj0, gj1, gjx, gjy = gax.dot(m0), gay.dot(m1), gax.dot(mz), gay.dot(mz)
    gm0, gm1, gm2 = j0 * gax, j1 * gay, jx * gax + jy * gay + gmz
    # Camera-frame centre
    inv_z2 = inv_z * inv_z
    gx, gy = gu * j0, gv * j1
    gzc = gz - (gu * fx * rx + gv * fy * ry) * inv_z - (gj0 * fx + gj1 * fy) * inv_z2
    jx_by_x, jx_by_z = jacobian_gradient(gjx, fx, rx, tx, inv_z2)
    jy_by_y, jy_by_z = jacobian_gradient(gjy, fy, ry, ty, inv_z2)
    gp = ti.Vector([gx + jx_by_x, gy + jy_by_y, gzc + jx_by_z + jy_by_z])
    gw = R.transpose() @ gp
    for c in ti.static(range(3)):
        grad_mean[i, c] = grad_mean[i, c] + gw[c]
    # Left perturbation: dx = w cross x + t, dM = [w] M
    turn = x.cross(gp)
    for k in ti.static(range(3)):
        turn += ti.Vector([M[0, k], M[1, k], M[2, k]]).cross(ti.Vector([gm0[k], gm1[k], gm2[k]]))
    # M = R Rq S
    H = R.transpose() @ ti.Matrix.rows([gm0, gm1, gm2])
    for k in ti.static(range(3)):
        for r in ti.static(range(3)):
            H[r, k] *= s[k]
        # A's column k times its own gradient, and mz's, with what cancels left out
        gs = gmz[k] * rest[k] - gbx[k] * bx[k] - gby[k] * by[k]
        grad_log_scale[i, k] = grad_log_scale[i, k] + 2.0 * gs
    gq = quat_gradient(H, q)
    gq = (gq - q * gq.dot(q)) * inv_norm
    for k in ti.static(range(4)):
        grad_quat[i, k] = grad_quat[i, k] + gq[k]
    grad_opacity_logit[i] = grad_opacity_logit[i] + moments[i, M_0] * sigmoid(-opacity_logit[i])
    for k in ti.static(range(3)):
        grad_colour[i, k] = grad_colour[i, k] + moments[i, M_RED + k]
        if ti.static(with_embedding):
            e = sigmoid(embedding[i, k])
            grad_embedding[i, k] = grad_embedding[i, k] + moments[i, M_EMBEDDING + k] * e * (1.0 - e)
    curvature[i, 0] = curvature[i, 0] + moments[i, M_CURVATURE_COLOUR]
    curvature[i, 1] = curvature[i, 1] + moments[i, M_CURVATURE_DEPTH]
    return ti.Vector([turn[0], turn[1], turn[2], gp[0], gp[1], gp[2]])


@ti.kernel
def project_backward(
    count: ti.i32,
    mean: nd(ti.f32, ndim=2),  # [N, 3] m, world
    log_scale: nd(ti.f32, ndim=2),  # [N, 3] log m
    quat: nd(ti.f32, ndim=2),  # [N, 4] wxyz
    opacity_logit: nd(ti.f32, ndim=1),  # [N]
    embedding: nd(ti.f32, ndim=2),  # [N, 3] theta
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
    if ti.static(ti.cfg.arch == ti.cuda):
        ti.loop_config(block_dim=128)  # a Gaussian takes many registers
        for i in range(grad_pose.shape[0] * POSE_BLOCK):
            part = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
            if i < count:
                if tile_count[i] > 0:
                    part = gaussian_backward(
                        i, mean, log_scale, quat, opacity_logit, embedding, pose, camera, width, height,
                        with_embedding, moments, grad_mean, grad_log_scale, grad_quat, grad_opacity_logit, grad_colour,
                        grad_embedding, curvature,
                    )  # fmt: skip
            for c in ti.static(range(6)):
                total = warp_sum(part[c])
                if i % POSE_BLOCK == c:
                    grad_pose[i // POSE_BLOCK, c] = total
    else:
        for block in range(grad_pose.shape[0]):
            pose_sum = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
            for i in range(block * POSE_BLOCK, ti.min((block + 1) * POSE_BLOCK, count)):
                if tile_count[i] > 0:
                    pose_sum += gaussian_backward(
                        i, mean, log_scale, quat, opacity_logit, embedding, pose, camera, width, height,
                        with_embedding, moments, grad_mean, grad_log_scale, grad_quat, grad_opacity_logit, grad_colour,
                        grad_embedding, curvature,
                    )  # fmt: skip
            for c in ti.static(range(6)):
                grad_pose[block, c] = pose_sum[c]
