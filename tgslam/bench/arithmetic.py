"""How much arithmetic a (Gaussian, pixel) pair costs, read off the kernels (`tests/test_bench.py` counts it again).

Additions, subtractions, multiplications and divisions as written count one each, so that a multiply-add is two.
Minima, maxima, comparisons and selections count nothing, and neither does what is done once a slot, chunk or Gaussian.
Both counts are for colour, depth and opacity, without embeddings and curvature.
"""

# Offset from the centre                          2
# Exponent: quadratic form and fade               8
# exp: polynomial in pairs, three squarings      14
# Blend weight                                    1
# Colour                                          6
# Depth: step, tangent plane to second order      9
# Transmittance                                   1
FORWARD_FLOPS = 41

# Offset, exponent, exp, weight                  25
# Depth's step, and dL/dweight                   15
# dL/dalpha: what lies behind, by 1 - alpha       7
# Transmittance                                   1
# Colour gradient                                 6
# Depth gradient and its moments                 14
# Moments of alpha's gradient to second order    11
BACKWARD_FLOPS = 79
