"""Gauss-Newton normal equations of RGB-D alignment: point-to-plane depth, intensity and intensity gradient.

The unknowns are a left perturbation of T_ml (live camera to model camera). Model and live images share one camera.
Moments of the matched intensities come along, from which the exposure follows in closed form.

Every residual's Jacobian has the form (x cross a, a), x the point in the model camera's frame: a is the surface's
normal for depth, and the image gradient carried back through the projection for colour. So a pixel's part of the
normal matrix follows from the 3x3 matrix B = sum of w a a^T and the vector c = sum of w e a over its residuals:

    J^T W J = ([x] B [x]^T, [x] B; B [x]^T, B),   J^T W e = (x cross c, c).

The mathematics is written once, for a pixel (`kernels.cuda.alignment`) and for 16 of them as `Lanes` (here) alike: no
branches, pixels that take no part have weight 0.
"""

import taichi as ti

from tgslam.kernels.simd import LANES, Lanes, lane_max, lanes_kernel, larger, smaller, sums_of_16

UNKNOWNS = 6  # rotation 3, translation 3
TRIANGLE = UNKNOWNS * (UNKNOWNS + 1) // 2
ROWS = 4  # image rows that share a row of sums

# Columns of a row of sums: upper triangle of J^T W J, J^T W r, then the statistics
RHS = TRIANGLE
CANDIDATES, MATCHED, INLIERS, DEPTH_SUM, COLOUR_SUM = (RHS + UNKNOWNS + k for k in range(5))
W, W_L, W_M, W_LL, W_LM = (COLOUR_SUM + 1 + k for k in range(5))  # moments of live (L) and model (M) intensity
LIVE_PIXELS = W_LM + 1  # with depth
SHOWN = LIVE_PIXELS + 1  # matched pixels whose colours count
SUMS = SHOWN + 1
PACKED_SUMS = -(-SUMS // LANES)  # vectors that hold a row of sums
PADDED_SUMS = PACKED_SUMS * LANES

# Entries of the settings array; the last 12 are T_ml's rows [R | t]
(
    FX,
    FY,
    CX,
    CY,
    GAIN,
    BIAS,
    DEPTH_SIGMA,  # the sensor's sigma_z = this * z^2
    MAX_DISTANCE_SIGMAS,  # depth residuals beyond are no match
    CHARBONNIER_DEPTH,  # epsilon in sigmas
    GATE_DEPTH_BOOST,
    SIGMA_COLOUR,
    SIGMA_GRADIENT,
    WEIGHT_DEPTH,
    WEIGHT_COLOUR,
    WEIGHT_GRADIENT,
    SURFACE_SIGMA,  # m, the map's own error, added to the sensor's in the weights
    LIVE_SHARE,  # of the measured depth in the one that noise is taken at; the model's has the rest
    GATE_LOW,  # G_min of Eq. 11, 1/px
    GATE_INVERSE_RANGE,  # 1 / (G_max - G_min + epsilon)
    POSE,
) = range(20)
SETTINGS = POSE + 12

# What a live pixel holds: m, intensity, its gradient and that one's length (G of Eq. 10) in 1/px, negative where the
# sensor was saturated
LIVE_DEPTH, LIVE_GREY, LIVE_GX, LIVE_GY, LIVE_STRENGTH = range(5)
LIVE = 5  # of them
# What a model pixel holds: its surface (a normal in the model camera's frame, 0 = none, then the depth in m, 0 = none,
# negative at the rim of the map and where a measured image is saturated), and its intensity with the first and second
# derivatives by the pixel
MODEL_DEPTH = 3
SURFACE = 4
GREY, GX, GY, GXX, GXY, GYY = range(6)
TEXTURE = 8  # of them, padded to a power of two

_INLIER_SIGMAS = 3.0  # of a matched pixel's depth residual, to count as an inlier
_MIN_COSINE = 0.2  # grazing rays: the noise across the surface is taken to be no less than this share of that along z
_NEAR_M = 0.05  # points nearer to the model's camera are not looked up
_MIN_DEPTH_M = 1e-3  # keeps what does not count finite
_LANE = tuple(float(j) for j in range(LANES))
_PART_STEP = 128  # a loop over parts counts in steps of this, since Taichi hands a thread 512 iterations at a time

SMALLEST = 4  # px, a side of an image in which any point can be looked up

nd = ti.types.ndarray
F1 = nd(dtype=ti.f32, ndim=1)
Surface = ti.types.vector(SURFACE, ti.f32)
Texture = ti.types.vector(TEXTURE, ti.f32)


def triangle(a, b):
    """Index of element (a, b), a <= b, in a symmetric matrix's upper triangle stored row by row."""
    return a * UNKNOWNS - a * (a - 1) // 2 + b - a


def parts(height):
    """Rows of sums for an image of that height."""
    return -(-height // ROWS)


@ti.func
def filled(like, value):
    """`value` in the form of `like`, a scalar or Lanes."""
    return like - like + value


@ti.func
def indicator(a, b):
    """1 where a < b, else 0."""
    return ti.select(a < b, filled(a, 1.0), filled(a, 0.0))


@ti.func
def magnitude(x):
    """|x|."""
    return larger(x, 0.0 - x)


@ti.func
def irls_weight(squared):
    """Weight of the Charbonnier penalty rho(x) = sqrt(x^2 + 1) in reweighted least squares: rho'(x) / x."""
    return 1.0 / ti.sqrt(1.0 + squared)


@ti.func
def reprojected(settings: ti.template(), u, v, depth):
    """The live pixel's ray (x, y) at depth 1, and its point (x, y, z) in the model camera's frame, m."""
    ray_x, ray_y = (u - settings[CX]) * (1.0 / settings[FX]), (v - settings[CY]) * (1.0 / settings[FY])
    x = depth * (settings[POSE] * ray_x + settings[POSE + 1] * ray_y + settings[POSE + 2]) + settings[POSE + 3]
    y = depth * (settings[POSE + 4] * ray_x + settings[POSE + 5] * ray_y + settings[POSE + 6]) + settings[POSE + 7]
    z = depth * (settings[POSE + 8] * ray_x + settings[POSE + 9] * ray_y + settings[POSE + 10]) + settings[POSE + 11]
    return ray_x, ray_y, x, y, z


@ti.func
def add(sums: ti.template(), row, column: ti.template(), value):
    """Add to one entry. `+=` would be atomic."""
    sums[row, column] = sums[row, column] + value


@ti.func
def add_symmetric(sums: ti.template(), row, x, y, z, c00, c01, c02, c10, c11, c12, c20, c21, c22):
    """Add the rotations' block [x] B [x]^T, given C = [x] B and the point."""
    add(sums, row, ti.static(triangle(0, 0)), c02 * y - c01 * z)
    add(sums, row, ti.static(triangle(0, 1)), c00 * z - c02 * x)
    add(sums, row, ti.static(triangle(0, 2)), c01 * x - c00 * y)
    add(sums, row, ti.static(triangle(1, 1)), c10 * z - c12 * x)
    add(sums, row, ti.static(triangle(1, 2)), c11 * x - c10 * y)
    add(sums, row, ti.static(triangle(2, 2)), c21 * x - c20 * y)


@ti.func
def add_products(sums: ti.template(), row, x, y, z, b00, b01, b02, b11, b12, b22, c0, c1, c2):
    """Add J^T W J and J^T W e of residuals of direction moments B (b) and c at the point (x, y, z)."""
    add(sums, row, ti.static(triangle(3, 3)), b00)
    add(sums, row, ti.static(triangle(3, 4)), b01)
    add(sums, row, ti.static(triangle(3, 5)), b02)
    add(sums, row, ti.static(triangle(4, 4)), b11)
    add(sums, row, ti.static(triangle(4, 5)), b12)
    add(sums, row, ti.static(triangle(5, 5)), b22)
    # C = [x] B, rotation by translation
    c00, c01, c02 = y * b02 - z * b01, y * b12 - z * b11, y * b22 - z * b12
    c10, c11, c12 = z * b00 - x * b02, z * b01 - x * b12, z * b02 - x * b22
    c20, c21, c22 = x * b01 - y * b00, x * b11 - y * b01, x * b12 - y * b02
    add(sums, row, ti.static(triangle(0, 3)), c00)
    add(sums, row, ti.static(triangle(0, 4)), c01)
    add(sums, row, ti.static(triangle(0, 5)), c02)
    add(sums, row, ti.static(triangle(1, 3)), c10)
    add(sums, row, ti.static(triangle(1, 4)), c11)
    add(sums, row, ti.static(triangle(1, 5)), c12)
    add(sums, row, ti.static(triangle(2, 3)), c20)
    add(sums, row, ti.static(triangle(2, 4)), c21)
    add(sums, row, ti.static(triangle(2, 5)), c22)
    add_symmetric(sums, row, x, y, z, c00, c01, c02, c10, c11, c12, c20, c21, c22)
    add(sums, row, RHS + 0, y * c2 - z * c1)
    add(sums, row, RHS + 1, z * c0 - x * c2)
    add(sums, row, RHS + 2, x * c1 - y * c0)
    add(sums, row, RHS + 3, c0)
    add(sums, row, RHS + 4, c1)
    add(sums, row, RHS + 5, c2)


@ti.func
def gate_at(settings: ti.template(), strength):
    """T of Eq. 11 for a gradient of that length: 1 = no texture."""
    share = (strength - settings[GATE_LOW]) * settings[GATE_INVERSE_RANGE]
    return 1.0 - smaller(larger(share, filled(share, 0.0)), filled(share, 1.0))


@ti.func
def add_residuals(
    settings: ti.template(),
    ray_x,  # of the live pixel
    ray_y,
    live,
    live_gx,
    live_gy,
    strength,
    x,  # its point in the model camera's frame
    y,
    z,
    seen,  # 1 where that falls into the model image
    nx,  # the model's surface at the nearest pixel
    ny,
    nz,
    surface_depth,
    near_u,  # that pixel
    near_v,
    model,  # the model's image at the point
    gx,
    gy,
    gxx,
    gxy,
    gyy,
    sums: ti.template(),
    row,
):
    """Add what live pixels say of Eqs. 12, 13 to a row of sums."""
    gate = gate_at(settings, strength)
    model_depth = magnitude(surface_depth)
    candidate = seen * indicator(filled(z, 0.0), model_depth)
    # at the map's rim colours fade into black: a pull that does not depend on the pose; and saturated ones are none
    firm = indicator(filled(z, 0.0), surface_depth) * (1.0 - indicator(strength, filled(z, 0.0)))
    # depth: e is the length of the residual, whose sign is the distance's
    # by the model's depth: by the measured one, what errs towards the camera would count for more. Of a model that errs
    # as much, by the mean of both
    share = settings[LIVE_SHARE]
    expected = larger(share * z + (1.0 - share) * model_depth, filled(z, _MIN_DEPTH_M))
    sensor = settings[DEPTH_SIGMA] * expected * expected
    has_normal = indicator(filled(z, 0.5), nx * nx + ny * ny + nz * nz)
    length = ti.sqrt(ray_x * ray_x + ray_y * ray_y + 1.0)
    cosine = larger((0.0 - (nx * ray_x + ny * ray_y + nz)) / length, filled(length, _MIN_COSINE))
    model_x = model_depth * ((near_u - settings[CX]) * (1.0 / settings[FX]))
    model_y = model_depth * ((near_v - settings[CY]) * (1.0 / settings[FY]))
    distance = nx * (x - model_x) + ny * (y - model_y) + nz * (z - model_depth)
    across = magnitude(distance) / cosine
    along = has_normal * across + (1.0 - has_normal) * magnitude(z - model_depth)
    matched = candidate * indicator(along, settings[MAX_DISTANCE_SIGMAS] * sensor)
    on_surface = matched * has_normal
    e = magnitude(distance) / (sensor * cosine)  # by which the pose is judged; the map's own error has no part in it
    inv_sigma = 1.0 / ((sensor + settings[SURFACE_SIGMA]) * cosine)
    scaled = magnitude(distance) * inv_sigma * (1.0 / settings[CHARBONNIER_DEPTH])
    weight = settings[WEIGHT_DEPTH] * on_surface * (1.0 + settings[GATE_DEPTH_BOOST] * gate)
    weight *= irls_weight(scaled * scaled) * inv_sigma * inv_sigma
    weight_x, weight_y, weight_z, weight_e = weight * nx, weight * ny, weight * nz, weight * distance
    # intensity
    inv_colour = 1.0 / settings[SIGMA_COLOUR]
    e_colour = inv_colour * (model - settings[GAIN] * live - settings[BIAS])
    robust = matched * firm * irls_weight(e_colour * e_colour)
    w_colour = robust * (settings[WEIGHT_COLOUR] * inv_colour)
    # its gradient, where there is texture
    inv_gradient = 1.0 / settings[SIGMA_GRADIENT]
    ex = inv_gradient * (gx - settings[GAIN] * live_gx)
    ey = inv_gradient * (gy - settings[GAIN] * live_gy)
    w_gradient = matched * firm * (1.0 - gate) * irls_weight(ex * ex + ey * ey)
    w_gradient *= settings[WEIGHT_GRADIENT] * inv_gradient
    # sums of w j j^T and w e j over both, j the derivative by the position in the model's image, then by the point
    inv_z = 1.0 / larger(z, filled(z, _NEAR_M))
    sx, sy = settings[FX] * inv_z, settings[FY] * inv_z
    p0 = sx * (w_colour * e_colour * gx + w_gradient * (ex * gxx + ey * gxy))
    p1 = sy * (w_colour * e_colour * gy + w_gradient * (ex * gxy + ey * gyy))
    w_colour *= inv_colour
    w_gradient *= inv_gradient
    p00 = sx * sx * (w_colour * gx * gx + w_gradient * (gxx * gxx + gxy * gxy))
    p01 = sx * sy * (w_colour * gx * gy + w_gradient * gxy * (gxx + gyy))
    p11 = sy * sy * (w_colour * gy * gy + w_gradient * (gxy * gxy + gyy * gyy))
    tx, ty = x * inv_z, y * inv_z
    p2, p02, p12 = 0.0 - (p0 * tx + p1 * ty), 0.0 - (p00 * tx + p01 * ty), 0.0 - (p01 * tx + p11 * ty)
    p22 = 0.0 - (p02 * tx + p12 * ty)
    add_products(
        sums, row, x, y, z,
        weight_x * nx + p00, weight_x * ny + p01, weight_x * nz + p02,
        weight_y * ny + p11, weight_y * nz + p12, weight_z * nz + p22,
        weight_e * nx + p0, weight_e * ny + p1, weight_e * nz + p2,
    )  # fmt: skip
    add(sums, row, CANDIDATES, candidate)
    add(sums, row, MATCHED, matched)
    add(sums, row, INLIERS, on_surface * indicator(e, filled(e, _INLIER_SIGMAS)))
    add(sums, row, DEPTH_SUM, on_surface * e)
    add(sums, row, COLOUR_SUM, matched * firm * magnitude(e_colour))
    add(sums, row, SHOWN, matched * firm)
    add(sums, row, W, robust)
    add(sums, row, W_L, robust * live)
    add(sums, row, W_M, robust * model)
    add(sums, row, W_LL, robust * live * live)
    add(sums, row, W_LM, robust * live * model)


@ti.func
def in_model_image(settings: ti.template(), x, y, z, width, height):
    """Where a point falls in the model's image, held inside [1, size - 2], and 1 if it was there without that.

    Returns u, v, px, and the indicator.
    """
    inv_z = 1.0 / larger(z, filled(z, _NEAR_M))
    u, v = settings[FX] * x * inv_z + settings[CX], settings[FY] * y * inv_z + settings[CY]
    seen = indicator(filled(z, _NEAR_M), z)
    seen *= (1.0 - indicator(u, filled(u, 1.0))) * (1.0 - indicator(v, filled(v, 1.0)))
    seen *= indicator(u, filled(u, width - 2.0)) * indicator(v, filled(v, height - 2.0))
    u = smaller(larger(u, filled(u, 1.0)), filled(u, width - 2.0))
    v = smaller(larger(v, filled(v, 1.0)), filled(v, height - 2.0))
    return u, v, seen


@ti.func
def bilinear(texture: ti.template(), x, y, fx, fy):
    """All values of the texture at (x + fx, y + fy)."""
    a, b, c, d = texture[y, x], texture[y, x + 1], texture[y + 1, x], texture[y + 1, x + 1]
    top = a + fx * (b - a)
    bottom = c + fx * (d - c)
    return top + fy * (bottom - top)


@ti.func
def add_16_pixels(
    settings: ti.template(),
    v,
    block,
    live: ti.template(),
    surface: ti.template(),
    texture: ti.template(),
    sums: ti.template(),
    row,
):
    """Add what a block of a row's live pixels says. Only the look-ups in the model go lane by lane."""
    height, width = surface.shape[0], surface.shape[1]
    depth = live[v, block, LIVE_DEPTH]
    u = Lanes(_LANE) + ti.cast(block * LANES, ti.f32)
    ray_x, ray_y, x, y, z = reprojected(settings, u, filled(u, ti.cast(v, ti.f32)), depth)
    um, vm, seen = in_model_image(settings, x, y, z, width, height)
    seen *= indicator(filled(z, 0.0), depth)
    nx, ny, nz, model_depth, near_u, near_v = Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0)
    grey, gx, gy, gxx, gxy, gyy = Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0)
    for j in ti.static(range(LANES)):
        u_near, v_near = ti.cast(um[j] + 0.5, ti.i32), ti.cast(vm[j] + 0.5, ti.i32)
        near_u[j], near_v[j] = ti.cast(u_near, ti.f32), ti.cast(v_near, ti.f32)
        s = surface[v_near, u_near]
        nx[j], ny[j], nz[j], model_depth[j] = s[0], s[1], s[2], s[MODEL_DEPTH]
        u_cell, v_cell = ti.cast(um[j], ti.i32), ti.cast(vm[j], ti.i32)
        t = bilinear(texture, u_cell, v_cell, um[j] - ti.cast(u_cell, ti.f32), vm[j] - ti.cast(v_cell, ti.f32))
        grey[j], gx[j], gy[j], gxx[j], gxy[j], gyy[j] = t[GREY], t[GX], t[GY], t[GXX], t[GXY], t[GYY]
    add_residuals(
        settings, ray_x, ray_y,
        live[v, block, LIVE_GREY], live[v, block, LIVE_GX], live[v, block, LIVE_GY], live[v, block, LIVE_STRENGTH],
        x, y, z, seen, nx, ny, nz, model_depth, near_u, near_v,
        grey, gx, gy, gxx, gxy, gyy, sums, row,
    )  # fmt: skip
    add(sums, row, LIVE_PIXELS, indicator(filled(z, 0.0), depth))


@ti.func
def lane_sums(sums: ti.template(), row, k):
    """Lane j: the sum of the lanes of entry k + j of a row."""
    return sums_of_16(
        sums[row, k], sums[row, k + 1], sums[row, k + 2], sums[row, k + 3],
        sums[row, k + 4], sums[row, k + 5], sums[row, k + 6], sums[row, k + 7],
        sums[row, k + 8], sums[row, k + 9], sums[row, k + 10], sums[row, k + 11],
        sums[row, k + 12], sums[row, k + 13], sums[row, k + 14], sums[row, k + 15],
    )  # fmt: skip


@lanes_kernel
def normal_equations(
    settings: F1,  # [SETTINGS]
    live: nd(Lanes, ndim=3),  # [H, B, LIVE], B = ceil(W / 16)
    surface: nd(Surface, ndim=2),  # [H, W]
    texture: nd(Texture, ndim=2),  # [H, W]
    sums: nd(Lanes, ndim=2),  # [parts(H), PADDED_SUMS] scratch
    packed: nd(Lanes, ndim=2),  # [parts(H), PACKED_SUMS] out: the sums of a part side by side, then zeros
):
    """Sum the weighted normal equations of Eqs. 12, 13 over the live pixels, a row of sums for each part of the image.

    SSIM (Eq. 12's third term) is no sum of squares and is left to the first-order solver.
    """
    for spread in range(packed.shape[0] * _PART_STEP):
        part = spread // _PART_STEP
        if spread - part * _PART_STEP == 0:
            for k in range(PADDED_SUMS):
                sums[part, k] = Lanes(0.0)
            if surface.shape[0] >= SMALLEST and surface.shape[1] >= SMALLEST:
                for v in range(part * ROWS, ti.min(part * ROWS + ROWS, surface.shape[0])):
                    for block in range(live.shape[1]):
                        if lane_max(live[v, block, LIVE_DEPTH]) > 0.0:
                            add_16_pixels(settings, v, block, live, surface, texture, sums, part)
            for k in range(PACKED_SUMS):
                packed[part, k] = lane_sums(sums, part, k * LANES)
