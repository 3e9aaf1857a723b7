"""Bookkeeping over the map's rows between the passes of a mapping iteration."""

import taichi as ti

from tgslam.kernels.objective import PIXELS

F1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
I1 = ti.types.ndarray(dtype=ti.i32, ndim=1)

ENOUGH_PX = 1e9  # more than any image has pixels


@ti.func
def pixel_curvature(totals: ti.template(), weight):
    """Curvature by a rendered channel that the intensity term has at a pixel of small residual.

    weight: weight of the term over three times the Charbonnier epsilon; totals: of the loss, counts come from there.
    """
    return weight / ti.max(totals[PIXELS], 1.0)


@ti.kernel
def clear_gradient(
    rows: ti.i32,
    mean: F2,  # [N, 3] out, as all that follow
    log_scale: F2,  # [N, 3]
    quat_wxyz: F2,  # [N, 4]
    opacity_logit: F1,  # [N]
    colour: F2,  # [N, 3]
    embedding: F2,  # [N, 3]
    curvature: F2,  # [N, 2]
):
    """Set the gradient of every row to zero."""
    for i in range(rows):
        for c in ti.static(range(3)):
            mean[i, c] = 0.0
            log_scale[i, c] = 0.0
            colour[i, c] = 0.0
            embedding[i, c] = 0.0
        for c in ti.static(range(4)):
            quat_wxyz[i, c] = 0.0
        opacity_logit[i] = 0.0
        curvature[i, 0] = 0.0
        curvature[i, 1] = 0.0


@ti.kernel
def record_view(
    rows: ti.i32,
    visible: I1,  # [N] 0 = the view does not have the row in sight
    curvature: F2,  # [N, 2] the first column is the colour's
    totals: F1,  # [TOTALS] of the view's loss
    weight: ti.f32,  # see `pixel_curvature`
    contribution: F1,  # [N] px, the most blend weight that any view gave the row, in and out
    views: I1,  # [N] views that had the row in sight, in and out
):
    """Count a view, and what each row contributed to its pixels, badly rendered ones less than well rendered ones.

    A loss without the intensity term cannot tell: whatever is in sight contributes enough.
    """
    for i in range(rows):
        if visible[i] != 0:
            pixel = pixel_curvature(totals, weight)
            weight_px = ti.select(pixel > 0.0, curvature[i, 0] / ti.max(pixel, 1e-30), ENOUGH_PX)
            contribution[i] = ti.max(contribution[i], weight_px)
            views[i] += 1
