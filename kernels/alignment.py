"""Gauss-Newton normal equations of RGB-D alignment: point-to-plane depth, intensity and intensity gradient.

The unknowns are a left perturbation of T_ml (live camera to model camera) and the live frame's gain and bias.
Model and live images share one camera. Each image row has one writer, so the sums repeat bit for bit.
"""

import taichi as ti

nd = ti.types.ndarray

UNKNOWNS = 8  # rotation 3, translation 3, gain, bias
TRIANGLE = UNKNOWNS * (UNKNOWNS + 1) // 2
# Columns of a row of partial sums: upper triangle of J^T W J, J^T W r, then the statistics
RHS = TRIANGLE
COST, CANDIDATES, MATCHED, INLIERS, DEPTH_SUM, COLOUR_SUM, COLOUR_COUNT = (RHS + UNKNOWNS + k for k in range(7))
PARTIAL = COLOUR_COUNT + 1

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
    SIGMA_COLOUR,
    SIGMA_GRADIENT,
    WEIGHT_DEPTH,
    WEIGHT_COLOUR,
    WEIGHT_GRADIENT,
    MIN_OPACITY,
) = range(15)
SETTINGS = 15


@ti.func
def bilinear(image: ti.template(), u, v):
    """Value of a [H, W] image at (u, v), both inside [0, size - 1)."""
    x, y = ti.cast(u, ti.i32), ti.cast(v, ti.i32)
    fx, fy = u - x, v - y
    top = image[y, x] + fx * (image[y, x + 1] - image[y, x])
    bottom = image[y + 1, x] + fx * (image[y + 1, x + 1] - image[y + 1, x])
    return top + fy * (bottom - top)


@ti.func
def charbonnier_weight(normalised):
    """IRLS weight of rho(x) = sqrt(x^2 + 1): rho'(x) / x."""
    return 1.0 / ti.sqrt(1.0 + normalised * normalised)


@ti.func
def image_jacobian(gx, gy, fx, fy, x: ti.template(), inv_z):
    """d image(project(X)) / d xi for an image gradient (gx, gy) in 1/px: (X x g3, g3) with g3 the gradient in 3D."""
    g3 = ti.Vector([gx * fx * inv_z, gy * fy * inv_z, 0.0])
    g3[2] = -(g3[0] * x[0] + g3[1] * x[1]) * inv_z
    turn = x.cross(g3)
    return ti.Vector([turn[0], turn[1], turn[2], g3[0], g3[1], g3[2], 0.0, 0.0])


@ti.kernel
def normal_equations(
    settings: nd(ti.f32, ndim=1),  # [SETTINGS]
    T_ml: nd(ti.f32, ndim=1),  # [12] live camera to model camera
    step: ti.i32,  # only every step-th pixel of every step-th row
    live_depth: nd(ti.f32, ndim=2),  # [H, W] m
    live_grey: nd(ti.f32, ndim=2),  # [H, W]
    live_gx: nd(ti.f32, ndim=2),  # [H, W] 1/px
    live_gy: nd(ti.f32, ndim=2),  # [H, W]
    gate: nd(ti.f32, ndim=2),  # [H, W] T of Eq. 11: 1 = no texture
    model_depth: nd(ti.f32, ndim=2),  # [H, W] m
    model_normal: nd(ti.f32, ndim=3),  # [H, W, 3] model camera frame, 0 = none
    model_grey: nd(ti.f32, ndim=2),  # [H, W]
    model_gx: nd(ti.f32, ndim=2),  # [H, W]
    model_gy: nd(ti.f32, ndim=2),  # [H, W]
    model_gxx: nd(ti.f32, ndim=2),  # [H, W] derivatives of the gradient images
    model_gxy: nd(ti.f32, ndim=2),  # [H, W]
    model_gyy: nd(ti.f32, ndim=2),  # [H, W]
    partial: nd(ti.f32, ndim=2),  # [rows, PARTIAL] out
):
    """Sum the weighted normal equations of Eqs. 12, 13 over the live pixels, one row of sums a row of pixels.

    SSIM (Eq. 12's third term) is no sum of squares and is left to the first-order solver.
    """
    for line in range(partial.shape[0]):
        for c in ti.static(range(PARTIAL)):
            partial[line, c] = 0.0
        v = line * step
        fx, fy = settings[FX], settings[FY]
        height, width = live_depth.shape[0], live_depth.shape[1]
        A = ti.Vector([0.0] * TRIANGLE)
        rhs = ti.Vector([0.0] * UNKNOWNS)
        cost, candidates, matched, inliers, depth_sum, colour_sum, colour_count = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range((width + step - 1) // step):
            u = i * step
            z = live_depth[v, u]
            if z > 0.0:
                ray = ti.Vector([(u - settings[CX]) / fx * z, (v - settings[CY]) / fy * z, z])
                x = ti.Vector([T_ml[4 * r] * ray[0] + T_ml[4 * r + 1] * ray[1] + T_ml[4 * r + 2] * ray[2] + T_ml[4 * r + 3]
                               for r in range(3)])  # fmt: skip
                inv_z = 1.0 / ti.max(x[2], 1e-3)
                um, vm = fx * x[0] * inv_z + settings[CX], fy * x[1] * inv_z + settings[CY]
                if x[2] > 0.05 and um >= 1.0 and vm >= 1.0 and um < width - 2.0 and vm < height - 2.0:
                    un, vn = ti.cast(um + 0.5, ti.i32), ti.cast(vm + 0.5, ti.i32)
                    zm = model_depth[vn, un]
                    n = ti.Vector([model_normal[vn, un, 0], model_normal[vn, un, 1], model_normal[vn, un, 2]])
                    if zm > 0.0:
                        candidates += 1.0
                        sigma_z = settings[DEPTH_SIGMA] * z * z
                        point = ti.Vector([(un - settings[CX]) / fx * zm, (vn - settings[CY]) / fy * zm, zm])
                        has_normal = n.dot(n) > 0.5
                        r = n.dot(x - point)
                        along = ti.abs(x[2] - zm)
                        if has_normal:
                            # what the tangent plane says of the distance along the ray
                            along = ti.abs(r) / ti.max(-n.dot(x) * inv_z, 0.2)
                        if along < settings[MAX_DISTANCE_SIGMAS] * sigma_z:
                            matched += 1.0
                            texture = 1.0 - gate[v, u]
                            if has_normal:
                                cosine = ti.max(-n.dot(ray) / ray.norm(), 0.2)
                                sigma = sigma_z * cosine
                                e = r / sigma
                                w = settings[WEIGHT_DEPTH] * (1.0 + gate[v, u])
                                w *= charbonnier_weight(e / settings[CHARBONNIER_DEPTH])
                                inliers += ti.select(ti.abs(e) < 3.0, 1.0, 0.0)
                                depth_sum += ti.abs(e)
                                cost += w * e * e
                                turn = x.cross(n) / sigma
                                J = ti.Vector([turn[0], turn[1], turn[2], n[0] / sigma, n[1] / sigma, n[2] / sigma])
                                k = 0
                                for a in ti.static(range(6)):
                                    rhs[a] += w * e * J[a]
                                    for b in ti.static(range(a, 6)):
                                        A[a * UNKNOWNS - a * (a - 1) // 2 + b - a] += w * J[a] * J[b]
                            gain, bias = settings[GAIN], settings[BIAS]
                            if settings[WEIGHT_COLOUR] > 0.0:
                                gx, gy = bilinear(model_gx, um, vm), bilinear(model_gy, um, vm)
                                s = 1.0 / settings[SIGMA_COLOUR]
                                e = s * (bilinear(model_grey, um, vm) - gain * live_grey[v, u] - bias)
                                w = settings[WEIGHT_COLOUR] * charbonnier_weight(e)
                                colour_sum += ti.abs(e)
                                colour_count += 1.0
                                cost += w * e * e
                                J = s * image_jacobian(gx, gy, fx, fy, x, inv_z)
                                J[6], J[7] = -s * live_grey[v, u], -s
                                for a in ti.static(range(UNKNOWNS)):
                                    rhs[a] += w * e * J[a]
                                    for b in ti.static(range(a, UNKNOWNS)):
                                        A[a * UNKNOWNS - a * (a - 1) // 2 + b - a] += w * J[a] * J[b]
                                if settings[WEIGHT_GRADIENT] > 0.0:
                                    sg = 1.0 / settings[SIGMA_GRADIENT]
                                    gxy = bilinear(model_gxy, um, vm)
                                    for axis in ti.static(range(2)):
                                        live_g = ti.select(axis == 0, live_gx[v, u], live_gy[v, u])
                                        value = ti.select(axis == 0, gx, gy)
                                        e = sg * (value - gain * live_g)
                                        w = settings[WEIGHT_GRADIENT] * texture * charbonnier_weight(e)
                                        cost += w * e * e
                                        if ti.static(axis == 0):
                                            J = sg * image_jacobian(bilinear(model_gxx, um, vm), gxy, fx, fy, x, inv_z)
                                        else:
                                            J = sg * image_jacobian(gxy, bilinear(model_gyy, um, vm), fx, fy, x, inv_z)
                                        J[6] = -sg * live_g
                                        for a in ti.static(range(7)):
                                            rhs[a] += w * e * J[a]
                                            for b in ti.static(range(a, 7)):
                                                A[a * UNKNOWNS - a * (a - 1) // 2 + b - a] += w * J[a] * J[b]
        for c in ti.static(range(TRIANGLE)):
            partial[line, c] = A[c]
        for c in ti.static(range(UNKNOWNS)):
            partial[line, RHS + c] = rhs[c]
        partial[line, COST], partial[line, CANDIDATES], partial[line, MATCHED] = cost, candidates, matched
        partial[line, INLIERS], partial[line, DEPTH_SUM] = inliers, depth_sum
        partial[line, COLOUR_SUM], partial[line, COLOUR_COUNT] = colour_sum, colour_count
