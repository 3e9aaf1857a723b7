"""Relaxation of colours and depths: blending is linear in both, so a step's length follows from the blend weights.

With residual weights W and residuals r, c_i += sum_p w_ip W_p r_p / sum_p w_ip W_p needs no learning rate (SIRT).
The numerator is minus the loss's gradient, the denominator the curvature that the rasterizer's backward pass sums.
"""

import taichi as ti

from tgslam.kernels.projection import CURVATURE_COLOUR, CURVATURE_DEPTH, RED, Z

nd = ti.types.ndarray


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
