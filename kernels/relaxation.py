"""Relaxation of colours and depths: blending is linear in both, so a step's length follows from the blend weights.

With residual weights W and residuals r, c_i += sum_p w_ip W_p r_p / sum_p w_ip W_p needs no learning rate (SIRT).
The numerator is minus the loss's gradient, the denominator the curvature that the rasterizer's backward pass sums.
"""

import taichi as ti

from tgslam.kernels.projection import CURVATURE_COLOUR, CURVATURE_DEPTH, RED, Z

nd = ti.types.ndarray


@ti.kernel
def residual_weights(
    colour: nd(ti.f32, ndim=3),  # [H, W, 3] rendered
    depth: nd(ti.f32, ndim=2),  # [H, W] rendered, accumulated, m
    opacity: nd(ti.f32, ndim=2),  # [H, W] rendered
    observed_colour: nd(ti.f32, ndim=3),  # [H, W, 3]
    observed_depth: nd(ti.f32, ndim=2),  # [H, W] m, 0 = none
    gate: nd(ti.f32, ndim=2),  # [H, W] T of Eq. 11
    gain: ti.f32,
    bias: ti.f32,
    epsilon_colour: ti.f32,
    epsilon_depth: ti.f32,  # in sigmas
    sigma_per_m2: ti.f32,
    gate_depth_boost: ti.f32,
    min_depth_opacity: ti.f32,
    scale_colour: ti.f32,  # weight of the colour term, a pixel and channel
    scale_depth: ti.f32,  # weight of the depth term, a pixel
    w_colour: nd(ti.f32, ndim=2),  # [H, W] out
    w_depth: nd(ti.f32, ndim=2),  # [H, W] out, 1/m^2
):
    """Second derivatives of the Charbonnier terms (Eqs. 12, 13) by a rendered channel, reweighted least squares."""
    for y in range(w_colour.shape[0]):
        for x in range(w_colour.shape[1]):
            squares = 0.0
            for c in ti.static(range(3)):
                r = gain * colour[y, x, c] + bias - observed_colour[y, x, c]
                squares += r * r
            w_colour[y, x] = scale_colour * gain * gain / ti.sqrt(squares / 3.0 + epsilon_colour * epsilon_colour)
            measured = observed_depth[y, x]
            w_depth[y, x] = 0.0
            if measured > 0.0 and opacity[y, x] > min_depth_opacity:
                inv_sigma = 1.0 / (sigma_per_m2 * measured * measured)
                e = (depth[y, x] / opacity[y, x] - measured) * inv_sigma
                weight = scale_depth * (1.0 + gate_depth_boost * gate[y, x]) / ti.sqrt(e * e + epsilon_depth**2)
                w_depth[y, x] = weight * (inv_sigma / opacity[y, x]) ** 2


@ti.kernel
def relax(
    count: ti.i32,
    tile_count: nd(ti.i32, ndim=1),  # [N] 0 = not rendered
    splat_grad: nd(ti.f32, ndim=2),  # [N, SPLAT_GRAD]
    splat_depth: nd(ti.f32, ndim=2),  # [N, SPLAT] for the depth column
    pose: nd(ti.f32, ndim=1),  # [12] T_cw
    step_colour: ti.f32,
    step_depth: ti.f32,
    floor_colour: ti.f32,  # added to the curvature: below it, evidence moves little
    floor_depth: ti.f32,
    max_shift: ti.f32,  # m at 1 m: a depth step is at most this times the depth squared
    colour: nd(ti.f32, ndim=2),  # [N, 3] changed
    mean: nd(ti.f32, ndim=2),  # [N, 3] m, world, changed along the ray from the camera
):
    """One relaxation step of the visible Gaussians' colours and depths."""
    for i in range(count):
        if tile_count[i] > 0:
            per_colour = step_colour / (splat_grad[i, CURVATURE_COLOUR] + floor_colour)
            for c in ti.static(range(3)):
                colour[i, c] = ti.min(ti.max(colour[i, c] - per_colour * splat_grad[i, RED + c], 0.0), 1.0)
            z = splat_depth[i, Z]
            shift = -step_depth * splat_grad[i, Z] / (splat_grad[i, CURVATURE_DEPTH] + floor_depth)
            limit = max_shift * z * z
            factor = ti.min(ti.max(shift, -limit), limit) / z
            centre = ti.Vector([0.0, 0.0, 0.0])  # of the camera, in the world: -R^T t
            for c in ti.static(range(3)):
                for r in ti.static(range(3)):
                    centre[c] -= pose[4 * r + c] * pose[4 * r + 3]
            for c in ti.static(range(3)):
                mean[i, c] += factor * (mean[i, c] - centre[c])
