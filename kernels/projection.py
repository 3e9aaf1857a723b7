"""Projection of 3D Gaussians to screen-space splats.

A splat is what the rasterizer needs of a Gaussian: centre, inverse covariance, opacity, tangent-plane depth, colour.
Columns of a splat row, and of the moments that the rasterizer's backward pass sums for it, are the constants below.

The functions take scalars and Lanes alike: a CUDA thread works on one Gaussian, the CPU on 16 at once. Vectors are
lists of components (matrices: lists of rows), which Taichi takes apart when it translates.
"""

import taichi as ti

from tgslam.kernels.simd import (
    LANES,
    REACH,
    TILE,
    Lanes,
    exponential,
    lanes_kernel,
)

nd = ti.types.ndarray
mat3 = ti.types.matrix(3, 3, ti.f32)

U, V, QA, QB, QC, FADE, Z, ZU, ZV, RED, EMBEDDING, INV_Z = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 12, 15
SPLAT = 16  # columns of a splat row: centre px, half the inverse covariance, -ln(opacity), depth and its slope, colours
# Sums over pixels; h = alpha dL/dalpha, w = blend weight, (x, y) = offset from the centre, s = first-order depth step
M_0, M_X, M_Y, M_XX, M_XY, M_YY = 0, 1, 2, 3, 4, 5  # h, h x, h y, h x^2, h x y, h y^2
M_DEPTH, M_DEPTH_X, M_DEPTH_Y, M_SLOPE = 6, 7, 8, 9  # of w dL/ddepth: (1 - s^2/z^2), (1 + 2s/z) x, same y, same
M_RED, M_CURVATURE_COLOUR, M_CURVATURE_DEPTH, M_EMBEDDING = 10, 13, 14, 16  # w times the pixel's gradient or weight
MOMENTS = 20

BLUR_DEPTH = 0.03  # px^2 in the regression of depth on the pixel: BLUR would flatten the depth slope of small splats
BLUR = 0.3  # px^2 added to the screen covariance, the 3DGS standard's low-pass filter
NEAR_M = 0.05  # splats nearer to the camera's plane are not drawn
EDGE = 1.3  # the Jacobian is evaluated at most this many half-images off the axis
_COLUMNS = 9  # of a splat row, U to ZV, that `splat_of` returns in their order, and INV_Z after them
# log((1 + t) / (1 - t)) / t by t^2, |t| <= 1/3, to 8e-9 relative: Lawson's iteratively reweighted least squares
_LOG = (2.0, 0.66666317, 0.400249094, 0.279606044, 0.281783342)


@ti.func
def sigmoid(x):
    """Logistic function, stable for both signs."""
    e = exponential(ti.min(x, 0.0 - x))
    return ti.select(x < 0.0, e, 1.0) / (1.0 + e)


@ti.func
def softplus(x):
    """log(1 + exp(x)), stable for both signs."""
    e = exponential(ti.min(x, 0.0 - x))
    t = e / (2.0 + e)
    tt = t * t
    return ti.max(x, 0.0) + t * (_LOG[0] + tt * (_LOG[1] + tt * (_LOG[2] + tt * (_LOG[3] + tt * _LOG[4]))))


@ti.func
def rotation_rows(w, x, y, z):
    """Unit quaternion -> rotation matrix, as a list of rows."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


@ti.func
def rotation_from_quat(w, x, y, z):
    """Unit quaternion -> rotation matrix."""
    return mat3(rotation_rows(w, x, y, z))


@ti.func
def dot(a: ti.template(), b: ti.template()):
    """a . b"""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@ti.func
def cross(a: ti.template(), b: ti.template()):
    """a x b"""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


@ti.func
def combined(a, u: ti.template(), b, v: ti.template(), c, w: ti.template()):
    """a u + b v + c w"""
    return [a * u[k] + b * v[k] + c * w[k] for k in ti.static(range(3))]


@ti.func
def in_camera(pose: ti.template(), mean):
    """The centre in the camera's frame; T_cw is stored row by row as [R | t]."""
    x, y, z = mean
    return [
        pose[0] * x + pose[1] * y + pose[2] * z + pose[3],
        pose[4] * x + pose[5] * y + pose[6] * z + pose[7],
        pose[8] * x + pose[9] * y + pose[10] * z + pose[11],
    ]


@ti.func
def axes_in_camera(pose: ti.template(), q: ti.template()):
    """R Rq, whose columns are the Gaussian's axes in the camera's frame, as a list of rows."""
    x, y, z = rotation_rows(q[0], q[1], q[2], q[3])
    return [
        combined(pose[0], x, pose[1], y, pose[2], z),
        combined(pose[4], x, pose[5], y, pose[6], z),
        combined(pose[8], x, pose[9], y, pose[10], z),
    ]


@ti.func
def inverse_norm(q: ti.template()):
    """1 / |q|"""
    return 1.0 / ti.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])


@ti.func
def in_view(ratio, centre, focal, size):
    """x/z (or y/z) limited to EDGE half-images, so that the linearisation stays sane beside the camera."""
    low = (-0.5 * (EDGE - 1.0) * size - centre) / focal
    high = ((0.5 + 0.5 * EDGE) * size - centre) / focal
    return ti.min(ti.max(ratio, low), high)


@ti.func
def scaled(s: ti.template(), v: ti.template()):
    """The components of v, each times its own of s."""
    return [s[k] * v[k] for k in ti.static(range(3))]


@ti.func
def mixed(a, v: ti.template(), b, w: ti.template()):
    """a v + b w"""
    return [a * v[k] + b * w[k] for k in ti.static(range(3))]


@ti.func
def inverse_determinant(area, xx, yy, blur):
    """1 / det of the screen covariance A A^T + blur I, by Lagrange's identity for det(A A^T) = |ax x ay|^2.

    cxx cyy - cxy^2 cancels to nothing in float32 for a long thin splat across the pixel grid; this sums positive terms.
    """
    return 1.0 / (area + blur * (xx + yy + blur))


@ti.func
def touched(centre, radius, last_px):
    """First row (or column) of tiles that [centre - radius, centre + radius] px touches, and the one after the last."""
    low, high = ti.max(centre - radius, 0.0), ti.min(centre + radius, last_px)
    end = ti.floor(high * (1.0 / TILE)) + 1.0
    return ti.select(low <= high, ti.floor(low * (1.0 / TILE)), 0.0), ti.select(low <= high, end, 0.0)


@ti.func
def splat_of(
    point: ti.template(),  # in the camera's frame
    log_scale,
    quat,
    opacity_logit,
    pose: ti.template(),
    camera: ti.template(),
    width,
    height,
):
    """A splat's columns, then the tiles it touches, in whole floats: x from, to before, y from, to before."""
    fx, fy = camera[0], camera[1]
    inv_norm = inverse_norm(quat)
    q = [quat[k] * inv_norm for k in ti.static(range(4))]
    axes = axes_in_camera(pose, q)
    s = [exponential(log_scale[k]) for k in ti.static(range(3))]
    z = ti.max(point[2], NEAR_M)  # what lies nearer is not drawn, but stays finite
    inv_z = 1.0 / z
    x, y = point[0] * inv_z, point[1] * inv_z
    j0, j1 = fx * inv_z, fy * inv_z
    ax = scaled(s, mixed(j0, axes[0], 0.0 - j0 * in_view(x, camera[2], fx, width), axes[2]))
    ay = scaled(s, mixed(j1, axes[1], 0.0 - j1 * in_view(y, camera[3], fy, height), axes[2]))
    mz = scaled(s, axes[2])
    normal = cross(ax, ay)
    area, xx, xy, yy = dot(normal, normal), dot(ax, ax), dot(ax, ay), dot(ay, ay)
    inv_det = inverse_determinant(area, xx, yy, BLUR)
    inv_depth_det = inverse_determinant(area, xx, yy, BLUR_DEPTH)
    cxx, cyy = xx + BLUR, yy + BLUR
    zu = (dot(mz, cross(ay, normal)) + BLUR_DEPTH * dot(mz, ax)) * inv_depth_det
    zv = (dot(mz, cross(normal, ax)) + BLUR_DEPTH * dot(mz, ay)) * inv_depth_det
    u, v = fx * x + camera[2], fy * y + camera[3]
    fade = softplus(0.0 - opacity_logit)
    reach = 2.0 * (REACH - fade)  # Mahalanobis^2 where alpha has fallen to ALPHA_MIN
    drawn = ti.min(reach, point[2] - NEAR_M) > 0.0
    reach = ti.max(reach, 0.0)
    x0, x1 = touched(u, ti.sqrt(reach * cxx), ti.select(drawn, width - 1.0, -1.0))
    y0, y1 = touched(v, ti.sqrt(reach * cyy), ti.select(drawn, height - 1.0, -1.0))
    return [
        u, v, 0.5 * cyy * inv_det, (0.0 - xy) * inv_det, 0.5 * cxx * inv_det, fade, z, zu, zv, inv_z, x0, x1, y0, y1
    ]  # fmt: skip


@ti.func
def store_splat(
    i,
    columns: ti.template(),
    colour: ti.template(),
    splat: ti.template(),
    tile_rect: ti.template(),
    tile_count: ti.template(),
):
    """Write what `splat_of` made of a Gaussian, with its colours, if it touches a tile."""
    x0, x1 = ti.cast(columns[_COLUMNS + 1], ti.i32), ti.cast(columns[_COLUMNS + 2], ti.i32)
    y0, y1 = ti.cast(columns[_COLUMNS + 3], ti.i32), ti.cast(columns[_COLUMNS + 4], ti.i32)
    tiles = (x1 - x0) * (y1 - y0)
    tile_count[i] = tiles
    if tiles > 0:
        tile_rect[i, 0], tile_rect[i, 1], tile_rect[i, 2], tile_rect[i, 3] = x0, x1 - 1, y0, y1 - 1
        for k in ti.static(range(_COLUMNS)):
            splat[i, k] = columns[k]
        splat[i, INV_Z] = columns[_COLUMNS]
        for c in ti.static(range(3)):
            splat[i, RED + c] = colour[i, c]


@ti.func
def row(i, array: ti.template(), columns: ti.template()):
    """A row of an array, as a list."""
    return [array[i, k] for k in ti.static(range(columns))]


@ti.func
def rows(first, count, array: ti.template(), columns: ti.template()):
    """LANES rows of an array from `first` on as a list of Lanes, a column each; the last of `count` rows goes on."""
    result = [Lanes(0.0) for k in ti.static(range(columns))]
    for j in range(LANES):
        i = ti.min(first + j, count - 1)
        for k in ti.static(range(columns)):
            result[k][j] = array[i, k]
    return result


@ti.func
def shapes(first, count, log_scale: ti.template(), quat: ti.template(), opacity_logit: ti.template()):
    """The same of what makes a Gaussian's shape: three, four and one column."""
    scales = [Lanes(0.0) for k in ti.static(range(3))]
    turns = [Lanes(0.0) for k in ti.static(range(4))]
    logit = Lanes(0.0)
    for j in range(LANES):
        i = ti.min(first + j, count - 1)
        for k in ti.static(range(3)):
            scales[k][j] = log_scale[i, k]
        for k in ti.static(range(4)):
            turns[k][j] = quat[i, k]
        logit[j] = opacity_logit[i]
    return scales, turns, logit


@lanes_kernel
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
    splat: nd(ti.f32, ndim=2),  # [N, SPLAT] out where a tile is touched
    tile_rect: nd(ti.i32, ndim=2),  # [N, 4] out, likewise: first and last tile in x, then in y
    tile_count: nd(ti.i32, ndim=1),  # [N] out: tiles touched
):
    """Gaussians -> splats and the tiles that their alpha >= 1/255 box touches (Zwicker's EWA, as 3DGS)."""
    w, h = ti.cast(width, ti.f32), ti.cast(height, ti.f32)
    if ti.static(ti.cfg.arch == ti.cuda):
        for i in range(count):
            point = in_camera(pose, row(i, mean, 3))
            tile_count[i] = 0
            if point[2] > NEAR_M:
                columns = splat_of(
                    point, row(i, log_scale, 3), row(i, quat, 4), opacity_logit[i], pose, camera, w, h
                )  # fmt: skip
                store_splat(i, columns, colour, splat, tile_rect, tile_count)
                if ti.static(with_embedding):
                    if tile_count[i] > 0:
                        for c in ti.static(range(3)):
                            splat[i, EMBEDDING + c] = sigmoid(embedding[i, c])
    else:
        for block in range((count + LANES - 1) // LANES):
            first, after = block * LANES, ti.min(block * LANES + LANES, count)
            point = in_camera(pose, rows(first, count, mean, 3))
            ahead = 0  # 1: one of them at least
            for j in range(LANES):
                ahead = ti.select(point[2][j] > NEAR_M, 1, ahead)
            if ahead == 1:
                scales, turns, logit = shapes(first, count, log_scale, quat, opacity_logit)
                columns = splat_of(point, scales, turns, logit, pose, camera, w, h)
                for i in range(first, after):
                    of_one = [columns[k][i - first] for k in ti.static(range(_COLUMNS + 5))]
                    store_splat(i, of_one, colour, splat, tile_rect, tile_count)
                if ti.static(with_embedding):
                    theta = rows(first, count, embedding, 3)
                    shade = [sigmoid(theta[c]) for c in ti.static(range(3))]
                    for i in range(first, after):
                        if tile_count[i] > 0:
                            for c in ti.static(range(3)):
                                splat[i, EMBEDDING + c] = shade[c][i - first]
            else:
                for i in range(first, after):
                    tile_count[i] = 0
