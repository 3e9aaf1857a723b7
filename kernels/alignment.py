"""Gauss-Newton normal equations of RGB-D alignment: point-to-plane depth, intensity and intensity gradient.

The unknowns are a left perturbation of T_ml (live camera to model camera). Model and live images share one camera.
Moments of the matched intensities come along, from which the exposure follows in closed form.
Every partial sum has one writer, so the sums repeat bit for bit.
"""

import taichi as ti

from tgslam.kernels.image import F1, F2, F3

UNKNOWNS = 6  # rotation 3, translation 3
TRIANGLE = UNKNOWNS * (UNKNOWNS + 1) // 2
SPLIT = 8  # segments of columns a row: loops of up to 512 iterations would run on one thread

# Columns of a row of partial sums: upper triangle of J^T W J, J^T W r, then the statistics
RHS = TRIANGLE
CANDIDATES, MATCHED, INLIERS, DEPTH_SUM, COLOUR_SUM = (RHS + UNKNOWNS + k for k in range(5))
W, W_L, W_M, W_LL, W_LM = (COLOUR_SUM + 1 + k for k in range(5))  # moments of live (L) and model (M) intensity
PARTIAL = W_LM + 1

# Entries of the settings array
(
    FX,
    FY,
    CX,
    CY,
    GAIN,
    BIAS,
    DEPTH_SIGMA,  # sigma_z = this * z^2
    MAX_DISTANCE_SIGMAS,  # depth residuals beyond are no match
    CHARBONNIER_DEPTH,  # epsilon in sigmas
    GATE_DEPTH_BOOST,
    SIGMA_COLOUR,
    SIGMA_GRADIENT,
    WEIGHT_DEPTH,
    WEIGHT_COLOUR,
    WEIGHT_GRADIENT,
) = range(15)
SETTINGS = 15

_INLIER_SIGMAS = 3.0
_MIN_COSINE = 0.2  # grazing rays: the noise across the surface is taken to be no less than this share of that along z
_NEAR_M = 0.05

vec3 = ti.types.vector(3, ti.f32)
vec6 = ti.types.vector(UNKNOWNS, ti.f32)


def triangle(a, b):
    """Index of element (a, b), a <= b, in a symmetric matrix's upper triangle stored row by row."""
    return a * UNKNOWNS - a * (a - 1) // 2 + b - a


@ti.func
def bilinear(image: ti.template(), u, v):
    """Value of a [H, W] image at (u, v), both inside [0, size - 1)."""
    x, y = ti.cast(u, ti.i32), ti.cast(v, ti.i32)
    fx, fy = u - x, v - y
    top = image[y, x] + fx * (image[y, x + 1] - image[y, x])
    bottom = image[y + 1, x] + fx * (image[y + 1, x + 1] - image[y + 1, x])
    return top + fy * (bottom - top)


@ti.func
def irls_weight(normalised):
    """Weight of the Charbonnier penalty rho(x) = sqrt(x^2 + 1) in reweighted least squares: rho'(x) / x."""
    return 1.0 / ti.sqrt(1.0 + normalised * normalised)


@ti.func
def motion_jacobian(x, direction):
    """d (direction . x) / d xi for a left perturbation of the transform that gave x: (x cross direction, direction)."""
    turn = x.cross(direction)
    return vec6([turn[0], turn[1], turn[2], direction[0], direction[1], direction[2]])


@ti.func
def image_jacobian(gx, gy, fx, fy, x, inv_z):
    """d image(project(x)) / d xi for an image gradient (gx, gy) in 1/px."""
    dx, dy = gx * fx * inv_z, gy * fy * inv_z
    return motion_jacobian(x, vec3([dx, dy, -(dx * x[0] + dy * x[1]) * inv_z]))


@ti.kernel
def normal_equations(
    settings: F1,  # [SETTINGS]
    T_ml: F1,  # [12] live camera to model camera
    live_depth: F2,  # [H, W] m
    live_grey: F2,  # [H, W]
    live_gx: F2,  # [H, W] 1/px
    live_gy: F2,  # [H, W]
    gate: F2,  # [H, W] T of Eq. 11: 1 = no texture
    model_depth: F2,  # [H, W] m
    model_normal: F3,  # [H, W, 3] model camera frame, 0 = none
    model_grey: F2,  # [H, W]
    model_gx: F2,  # [H, W]
    model_gy: F2,  # [H, W]
    model_gxx: F2,  # [H, W] derivatives of the gradient images
    model_gxy: F2,  # [H, W]
    model_gyy: F2,  # [H, W]
    partial: F2,  # [H * SPLIT, PARTIAL] out
):
    """Sum the weighted normal equations of Eqs. 12, 13 over the live pixels, a row of sums for a segment of pixels.

    SSIM (Eq. 12's third term) is no sum of squares and is left to the first-order solver.
    """
    for part in range(partial.shape[0]):
        height, width = live_depth.shape[0], live_depth.shape[1]
        v = part // SPLIT
        begin, end = (part - v * SPLIT) * width // SPLIT, (part - v * SPLIT + 1) * width // SPLIT
        fx, fy, cx, cy = settings[FX], settings[FY], settings[CX], settings[CY]
        sums = ti.Vector([0.0] * PARTIAL)
        for u in range(begin, end):
            z = live_depth[v, u]
            if z > 0.0:
                ray = vec3([(u - cx) / fx * z, (v - cy) / fy * z, z])
                x = vec3([T_ml[3], T_ml[7], T_ml[11]])
                for r in ti.static(range(3)):
                    for c in ti.static(range(3)):
                        x[r] += T_ml[4 * r + c] * ray[c]
                inv_z = 1.0 / ti.max(x[2], _NEAR_M)
                um, vm = fx * x[0] * inv_z + cx, fy * x[1] * inv_z + cy
                if x[2] > _NEAR_M and um >= 1.0 and vm >= 1.0 and um < width - 2.0 and vm < height - 2.0:
                    un, vn = ti.cast(um + 0.5, ti.i32), ti.cast(vm + 0.5, ti.i32)
                    zm = model_depth[vn, un]
                    if zm > 0.0:
                        sums[CANDIDATES] += 1.0
                        sigma_z = settings[DEPTH_SIGMA] * z * z
                        n = vec3([model_normal[vn, un, 0], model_normal[vn, un, 1], model_normal[vn, un, 2]])
                        has_normal = n.dot(n) > 0.5
                        cosine = ti.max(-n.dot(ray) / ray.norm(), _MIN_COSINE)
                        distance = n.dot(x - vec3([(un - cx) / fx * zm, (vn - cy) / fy * zm, zm]))
                        along = ti.select(has_normal, ti.abs(distance) / cosine, ti.abs(x[2] - zm))
                        if along < settings[MAX_DISTANCE_SIGMAS] * sigma_z:
                            sums[MATCHED] += 1.0
                            if has_normal:
                                inv_sigma = 1.0 / (sigma_z * cosine)
                                e = distance * inv_sigma
                                w = settings[WEIGHT_DEPTH] * (1.0 + settings[GATE_DEPTH_BOOST] * gate[v, u])
                                w *= irls_weight(e / settings[CHARBONNIER_DEPTH])
                                sums[INLIERS] += ti.select(ti.abs(e) < _INLIER_SIGMAS, 1.0, 0.0)
                                sums[DEPTH_SUM] += ti.abs(e)
                                J = inv_sigma * motion_jacobian(x, n)
                                for a in ti.static(range(UNKNOWNS)):
                                    sums[RHS + a] += w * e * J[a]
                                    for b in ti.static(range(a, UNKNOWNS)):
                                        sums[ti.static(triangle(a, b))] += w * J[a] * J[b]
                            # intensity
                            live, model = live_grey[v, u], bilinear(model_grey, um, vm)
                            gx, gy = bilinear(model_gx, um, vm), bilinear(model_gy, um, vm)
                            inv_colour = 1.0 / settings[SIGMA_COLOUR]
                            e = inv_colour * (model - settings[GAIN] * live - settings[BIAS])
                            robust = irls_weight(e)
                            w = settings[WEIGHT_COLOUR] * robust
                            sums[COLOUR_SUM] += ti.abs(e)
                            sums[W] += robust
                            sums[W_L] += robust * live
                            sums[W_M] += robust * model
                            sums[W_LL] += robust * live * live
                            sums[W_LM] += robust * live * model
                            J = inv_colour * image_jacobian(gx, gy, fx, fy, x, inv_z)
                            for a in ti.static(range(UNKNOWNS)):
                                sums[RHS + a] += w * e * J[a]
                                for b in ti.static(range(a, UNKNOWNS)):
                                    sums[ti.static(triangle(a, b))] += w * J[a] * J[b]
                            # gradient, where there is texture
                            texture = 1.0 - gate[v, u]
                            if settings[WEIGHT_GRADIENT] * texture > 0.0:
                                inv_gradient = 1.0 / settings[SIGMA_GRADIENT]
                                gxy = bilinear(model_gxy, um, vm)
                                ex = inv_gradient * (gx - settings[GAIN] * live_gx[v, u])
                                ey = inv_gradient * (gy - settings[GAIN] * live_gy[v, u])
                                wg = settings[WEIGHT_GRADIENT] * texture * irls_weight(ti.sqrt(ex * ex + ey * ey))
                                Jx = image_jacobian(bilinear(model_gxx, um, vm), gxy, fx, fy, x, inv_z) * inv_gradient
                                Jy = image_jacobian(gxy, bilinear(model_gyy, um, vm), fx, fy, x, inv_z) * inv_gradient
                                for a in ti.static(range(UNKNOWNS)):
                                    sums[RHS + a] += wg * (ex * Jx[a] + ey * Jy[a])
                                    for b in ti.static(range(a, UNKNOWNS)):
                                        sums[ti.static(triangle(a, b))] += wg * (Jx[a] * Jx[b] + Jy[a] * Jy[b])
        for c in ti.static(range(PARTIAL)):
            partial[part, c] = sums[c]
