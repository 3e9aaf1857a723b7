"""Relaxation of colours: blending is linear in them, so a step's length follows from the blend weights.

With residual weights W and residuals r, c_i += sum_p w_ip W_p r_p / sum_p w_ip W_p needs no learning rate (SIRT).
The numerator is minus the loss's gradient, the denominator the curvature that the rasterizer's backward pass sums.
"""

import taichi as ti

from tgslam.kernels.rows import pixel_curvature

nd = ti.types.ndarray


@ti.kernel
def relax(
    count: ti.i32,
    visible: nd(ti.i32, ndim=1),  # [N] 0 = leave the Gaussian alone
    grad_colour: nd(ti.f32, ndim=2),  # [N, 3]
    curvature: nd(ti.f32, ndim=2),  # [N, 2] the first column is the colour's
    totals: nd(ti.f32, ndim=1),  # [TOTALS] of the loss
    step: ti.f32,  # 1 = the full step
    weight: ti.f32,  # see `pixel_curvature`: that much is added to the curvature, so that little evidence moves little
    colour: nd(ti.f32, ndim=2),  # [N, 3] changed, kept in [0, 1]
):
    """One relaxation step of the visible Gaussians' colours; none without curvature, as of a loss of other terms."""
    for i in range(count):
        whole = curvature[i, 0] + pixel_curvature(totals, weight)
        if visible[i] != 0 and whole > 0.0:
            per_colour = step / whole
            for c in ti.static(range(3)):
                colour[i, c] = ti.min(ti.max(colour[i, c] - per_colour * grad_colour[i, c], 0.0), 1.0)
