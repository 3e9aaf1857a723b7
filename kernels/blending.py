"""What one pixel computes of one splat: the same functions serve scalars (CUDA) and Lanes (CPU).

A splat's row is read into scalars; dx, dy are the pixel's offset from its centre in px. Its opacity is stored as `fade`
= -ln(opacity), so that alpha = exp(-(quadratic form + fade)), and the threshold on alpha is one on that exponent.
"""

import taichi as ti

from tgslam.kernels.simd import exp_neg


@ti.func
def raw_alpha(dx, dy, qa, qb, qc, fade):
    """A splat's alpha at a pixel, neither capped nor cut."""
    return exp_neg((qa * dx + qb * dy) * dx + (qc * dy) * dy + fade)


@ti.func
def tangent_depth(step, z, inv_z):
    """Depth of the tangent plane at an offset where its first-order depth change is `step`.

    Inverse depth is affine on a plane, so depth is z / (1 - step / z), here to second order. To first order alone,
    surfaces at grazing angles come out too near by about one sigma of the sensor, which turns and shifts a tracked
    camera.
    """
    return z + step * (1.0 + step * inv_z)
