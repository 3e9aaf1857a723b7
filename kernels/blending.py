"""What one pixel computes of one splat: the same functions serve scalars (CUDA) and Lanes (CPU).

A splat's row is read into scalars; dx, dy are the pixel's offset from its centre in px. Its opacity is stored as `fade`
= -ln(opacity), so that alpha = exp(-(quadratic form + fade)), and the threshold on alpha is one on that exponent.
"""

import taichi as ti

from tgslam.kernels.simd import at_least, exp_neg, larger, smaller


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


@ti.func
def least_exponent(xa, ya, xb, yb, a, b, c):
    """Least a x^2 + b x y + c y^2 over the rectangle [xa, xb] x [ya, yb]; the form is positive.

    It is taken where one of the two lines of the rectangle nearest to the origin comes nearest to it in that metric.
    """
    x, y = smaller(at_least(xa, 0.0), xb), smaller(at_least(ya, 0.0), yb)
    y_at_x = smaller(larger((-0.5 * b / c) * x, ya), yb)
    x_at_y = smaller(larger((-0.5 * b / a) * y, xa), xb)
    on_column = (a * x + b * y_at_x) * x + c * y_at_x * y_at_x
    on_row = (a * x_at_y + b * y) * x_at_y + c * y * y
    return smaller(on_column, on_row)
