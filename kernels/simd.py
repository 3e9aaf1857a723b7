"""What the vector kernels share: 16 lanes are the 4x4 pixels of a chunk, of which 16 make a tile, or 16 Gaussians.

In a `lanes_kernel`, arithmetic on `Lanes` stays whole down to LLVM, which maps it to whatever vector registers the CPU
has; a plain `ti.kernel` takes vectors apart first, and LLVM's vectorizer does not find all of them again. What works
whole is `+ - * /`, `+=`, `*=`, `ti.min`, `ti.max`, `ti.sqrt`, `ti.floor`, comparisons and `ti.select`, a scalar float
in place of any of their operands but one. Lanes are filled and read one by one by a loop (`v[j]`), also at run time.
Casts (a Lanes times an integer is one), bit patterns, `abs`, `exp`, unary minus and `-=` abort in Taichi 1.7.4.
"""

import functools
import math
from collections.abc import Callable

import taichi as ti

TILE = 16  # px
LANES = 16  # floats of a vector: AVX-512's width
CHUNK = 4  # px, a side of the square of pixels that a vector holds
PER_ROW = TILE // CHUNK
CHUNKS = PER_ROW * PER_ROW
ALPHA_MIN = 1.0 / 255.0  # what covers a pixel less is left out of it: the 3DGS standard's bounds
ALPHA_MAX = 0.99
SPREAD = 16  # a loop over tiles counts in steps of this, since Taichi hands a thread 512 iterations at a time
T_MIN = 1e-4  # a chunk whose every pixel lets less than this through is finished

REACH = -math.log(ALPHA_MIN)  # exponent where alpha has fallen to ALPHA_MIN
_EXP_RANGE = 5.6  # a little beyond REACH: what is cut there is below the threshold
# exp(-x), 0 <= x <= 0.7, to 8e-8 relative: Lawson's iteratively reweighted least squares
_EXP = (0.999999921, -0.99999254, 0.499882589, -0.165973979, 0.0397725646, -0.00584676082)
_EXP_8TH = tuple(c / 8.0**k for k, c in enumerate(_EXP))
# 2^x - 1, |x| <= 0.5, by its powers, to 1.6e-8 relative, likewise
_E1, _E2, _E3, _E4, _E5, _E6 = 0.693147182, 0.240226462, 0.0555032864, 0.00961848907, 0.00133999309, 0.000153458124
_LOG2_E = 1.0 / math.log(2.0)

Lanes = ti.types.vector(LANES, ti.f32)
LANE_X = tuple(float(j % CHUNK) for j in range(LANES))  # px, of a lane's pixel in its chunk
LANE_Y = tuple(float(j // CHUNK) for j in range(LANES))
# By distance, as tables: Taichi would walk the expressions for every lane of every use again, in every process
_SWAPPED = {distance: tuple(j ^ distance for j in range(LANES)) for distance in (1, 2, 4, 8)}
_UPPER = {distance: tuple(float(j & distance) for j in range(LANES)) for distance in _SWAPPED}


def lanes_kernel(function: Callable[..., None]) -> Callable[..., None]:
    """A `ti.kernel` in which vectors stay whole; its Lanes arrays must start at a multiple of 64 bytes."""
    kernel = ti.kernel(function)

    @functools.wraps(function)
    def launch(*arguments: object) -> None:
        config = ti.cfg
        scalarize, config.real_matrix_scalarize = config.real_matrix_scalarize, False
        try:
            kernel(*arguments)
        finally:
            config.real_matrix_scalarize = scalarize

    return launch


def _is_vector(x: object) -> bool:
    return isinstance(x, ti.Matrix) or (hasattr(x, "is_tensor") and x.is_tensor())


@ti.func
def smaller(a, b):
    """The smaller of two Lanes (of two scalars) in one instruction; `ti.min` takes three, which handle NaN."""
    return ti.select(a < b, a, b)


@ti.func
def larger(a, b):
    """The larger of two Lanes (of two scalars), likewise."""
    return ti.select(a > b, a, b)


@ti.func
def at_most(x, bound: ti.template()):
    """`smaller` of x and a constant."""
    if ti.static(_is_vector(x)):
        return smaller(x, Lanes(bound))
    else:
        return smaller(x, bound)


@ti.func
def at_least(x, bound: ti.template()):
    """`larger` of x and a constant."""
    if ti.static(_is_vector(x)):
        return larger(x, Lanes(bound))
    else:
        return larger(x, bound)


@ti.func
def exponential(x):
    """exp(x) for scalars and Lanes alike; of Lanes |x| <= 44 (beyond, that of the limit), to the rounding of x.

    For Lanes 2^f 2^n with whole n, the second factor from n's binary digits, since they have no bit patterns.
    """
    if ti.static(not _is_vector(x)):
        return ti.exp(x)
    else:
        y = ti.max(ti.min(x * _LOG2_E, 63.0), -64.0)
        n = ti.floor(y + 0.5)
        f = y - n
        ff = f * f
        high = _E4 + f * _E5 + ff * _E6
        power = 2.0**-64 * (1.0 + f * _E1 + ff * (_E2 + f * _E3 + ff * high))
        n += 64.0
        digit, factor = 64.0, 2.0**64
        for _ in range(7):
            power *= ti.select(n < digit, 1.0, factor)
            n = ti.select(n < digit, n, n - digit)
            digit *= 0.5
            factor = ti.sqrt(factor)
        return power


@ti.func
def exp_neg(q):
    """exp(-q) for 0 <= q <= REACH, less than ALPHA_MIN beyond; relative error 2.1e-6. For scalars and Lanes alike.

    exp(-q / 8) by a polynomial, then three squarings: no casts and no bit patterns, which vectors cannot have.
    """
    x = at_most(q, _EXP_RANGE)
    xx = x * x
    low, middle, high = _EXP_8TH[0] + _EXP_8TH[1] * x, _EXP_8TH[2] + _EXP_8TH[3] * x, _EXP_8TH[4] + _EXP_8TH[5] * x
    root = low + xx * (middle + xx * high)
    root *= root
    root *= root
    return root * root


@ti.func
def swapped(v, distance: ti.template()):
    """Lane j gets lane j ^ distance."""
    return Lanes([v[j] for j in _SWAPPED[distance]])


@ti.func
def lane_sum(v):
    """Sum of the lanes, by halves: always in the same order."""
    for k in ti.static(range(4)):
        v = v + swapped(v, 8 >> k)
    return v[0]


@ti.func
def lane_max(v):
    """Largest of the lanes."""
    for k in ti.static(range(4)):
        v = larger(v, swapped(v, 8 >> k))
    return v[0]


@ti.func
def merged(a, b, distance: ti.template()):
    """Lane j gets a[j] + a[j ^ distance] where j & distance is 0, the same of b elsewhere."""
    upper = Lanes(_UPPER[distance]) > Lanes(0.0)
    return ti.select(upper, b, a) + ti.select(upper, swapped(b, distance), swapped(a, distance))


@ti.func
def sums_of_4(a, b, c, d):
    """Lanes whose lane j is the sum of the lanes of the (j % 4)-th argument."""
    v = merged(merged(a, b, 1), merged(c, d, 1), 2)
    v = v + swapped(v, 4)
    return v + swapped(v, 8)


@ti.func
def sums_of_16(v0, v1, v2, v3, v4, v5, v6, v7, v8, v9, v10, v11, v12, v13, v14, v15):
    """Lanes whose lane j is the sum of the lanes of vj: a transposition with additions, 45 vector operations."""
    low = merged(
        merged(merged(v0, v1, 1), merged(v2, v3, 1), 2),
        merged(merged(v4, v5, 1), merged(v6, v7, 1), 2),
        4,
    )
    high = merged(
        merged(merged(v8, v9, 1), merged(v10, v11, 1), 2),
        merged(merged(v12, v13, 1), merged(v14, v15, 1), 2),
        4,
    )
    return merged(low, high, 8)
