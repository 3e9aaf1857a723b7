"""Normals from plane fits of inverse depth, one fit a 2x2 block of pixels.

Three passes: inverse depth by block, the fits (on the CPU 16 blocks at a time; `kernels.cuda.normals` takes one a
thread), and the pixels that lie on their block's fit. Blocks have a border of zeros, MARGIN rows above and below and 16
columns left and right, so that no neighbourhood ends at the image's.
"""

import taichi as ti

from tgslam.kernels.alignment import MODEL_DEPTH
from tgslam.kernels.image import FAR_M, SPLIT, segment
from tgslam.kernels.simd import LANES, Lanes, lanes_kernel

LANE_BITS = 4  # of a column, which say where in its vector it lies
MARGIN = 3  # blocks: the largest radius of a fit

# What a block's fit holds: inverse depth at its middle, 1/m, its slopes by the pixel, and the unit normal towards the
# camera, 0 where there is no fit
W0, WX, WY, NX, NY, NZ = range(6)
FIT = 6

# Entries of the settings array
FX, FY, CX, CY, SIGMA, STEEPEST = range(6)  # px; standard deviation of inverse depth, 1/m; tangent of an angle
SETTINGS = 6

_SPREAD = 64  # the loop over rows counts in steps of this, since Taichi hands a thread 512 iterations at a time

nd = ti.types.ndarray


def least_count(radius):
    """Like blocks that a fit over (2 radius + 1)^2 needs: 30 % of them, and 4."""
    return max(0.3 * (2 * radius + 1) ** 2, 4.0)


@ti.kernel
def inverse_depth_blocks(
    depth: nd(ti.f32, ndim=2),  # [H, W] m, 0 = none
    relative: ti.f32,
    blocks: nd(ti.f32, ndim=3),  # [H // 2 + 2 MARGIN, B + 2, 16] 1/m, 0 = none, out but for the border
):
    """Mean inverse depth of the nearest surface in each 2x2 block."""
    rows, columns = depth.shape[0] // 2, depth.shape[1] // 2
    for s in range(rows * SPLIT):
        i, begin, end = segment(s, columns)
        for j in range(begin, end):
            nearest = 0.0
            for k in ti.static(range(4)):
                z = depth[2 * i + k // 2, 2 * j + k % 2]
                nearest = ti.max(nearest, ti.select(z > 0.0, 1.0 / ti.max(z, 1e-6), 0.0))
            total, count = 0.0, 0.0
            for k in ti.static(range(4)):
                z = depth[2 * i + k // 2, 2 * j + k % 2]
                w = 1.0 / ti.max(z, 1e-6)
                keep = ti.select((z > 0.0) and (w >= nearest * (1.0 - relative)), 1.0, 0.0)
                total += keep * w
                count += keep
            blocks[i + MARGIN, (j >> LANE_BITS) + 1, j & (LANES - 1)] = total / ti.max(count, 1.0)


@ti.func
def alike(w, centre, tolerance):
    """1 where the neighbour w belongs to the centre's surface, else 0; for floats and Lanes alike."""
    d, zero = w - centre, w - w
    return ti.select(ti.max(d, 0.0 - d) <= tolerance, zero + 1.0, zero) * ti.select(w > zero, zero + 1.0, zero)


@ti.func
def plane_fit(settings: ti.template(), u, v, centre, least, n, sx, sy, sxx, sxy, syy, sw, sxw, syw, sww):
    """The least squares plane of inverse depth over n like blocks, from sums of their offsets from the centre.

    u, v: px, middle of the block. s..: sums with x, y in blocks and w the inverse depth off the centre's. Returns the
    entries of a fit, for floats and Lanes alike.
    """
    zero = n - n
    one = zero + 1.0
    mean = 1.0 / ti.max(n, 1.0)
    cxx, cxy, cyy = sxx - sx * sx * mean, sxy - sx * sy * mean, syy - sy * sy * mean
    cxw, cyw, cww = sxw - sx * sw * mean, syw - sy * sw * mean, sww - sw * sw * mean
    det = cxx * cyy - cxy * cxy
    good = ti.select(det > 1e-3 * cxx * cyy, one, zero)
    inverse = 1.0 / ti.select(good > zero, det, one)
    wx, wy = (cyy * cxw - cxy * cyw) * inverse, (cxx * cyw - cxy * cxw) * inverse
    w0 = centre + (sw - wx * sx - wy * sy) * mean
    residual = ti.max(cww - wx * cxw - wy * cyw, 0.0) * mean
    a, b, sigma = 0.5 * wx, 0.5 * wy, settings[SIGMA]  # slopes by the pixel from here on
    good *= ti.select(n >= zero + least, one, zero) * ti.select(centre > zero, one, zero)
    good *= ti.select(w0 > zero, one, zero)
    good *= ti.select(residual <= 4.0 * sigma * sigma + 1e-5 * w0 * w0, one, zero)
    nx, ny = a * settings[FX], b * settings[FY]
    nz = w0 - a * (u - settings[CX]) - b * (v - settings[CY])
    length = ti.max(ti.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
    scale = (0.0 - good) / length
    return w0, a, b, nx * scale, ny * scale, nz * scale


def beside_lanes(x: int) -> list[tuple[int, int]]:
    """Of each lane's neighbour x columns away: 0 = the same vector, 1 = the one beside it, and the lane there."""
    return [(int(not 0 <= j + x < LANES), (j + x) % LANES) for j in range(LANES)]


@ti.func
def neighbours(blocks: ti.template(), row, block, x: ti.template()):
    """The blocks x columns beside those of a vector."""
    result = blocks[row, block]
    if ti.static(x != 0):
        here, beside = blocks[row, block], blocks[row, block + ti.static(1 if x > 0 else -1)]
        result = Lanes([(here, beside)[source][k] for source, k in ti.static(beside_lanes(x))])
    return result


@ti.func
def fit_16_blocks(settings: ti.template(), blocks: ti.template(), i, block, radius: ti.template(), fits: ti.template()):
    """The fits of a vector of blocks."""
    centre = blocks[i + MARGIN, block + 1]
    noise = Lanes(4.0 * settings[SIGMA])
    slope = centre * (2.0 * settings[STEEPEST] / ti.min(settings[FX], settings[FY]))
    zero = Lanes(0.0)
    n, sx, sy, sxx, sxy, syy, sw, sxw, syw, sww = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    for y in range(-radius, radius + 1):  # not unrolled: translating the rows one by one takes longer than it gains
        dy = ti.cast(y, ti.f32)
        row_n, row_x, row_w, row_xw = zero, zero, zero, zero
        for x in ti.static(range(-radius, radius + 1)):
            w = neighbours(blocks, i + MARGIN + y, block + 1, x)
            like = alike(w, centre, noise + slope * ti.max(float(abs(x)), ti.abs(dy)))
            d = like * (w - centre)
            row_n += like
            row_x += like * float(x)
            row_w += d
            row_xw += d * float(x)
            sxx += like * float(x * x)
            sww += d * d
        n, sx, sy, sw = n + row_n, sx + row_x, sy + row_n * dy, sw + row_w
        sxy, syy = sxy + row_x * dy, syy + row_n * (dy * dy)
        sxw, syw = sxw + row_xw, syw + row_w * dy
    u = (Lanes([float(j) for j in range(LANES)]) + ti.cast(block * LANES, ti.f32)) * 2.0 + 0.5
    v = zero + (2.0 * ti.cast(i, ti.f32) + 0.5)
    w0, wx, wy, nx, ny, nz = plane_fit(
        settings, u, v, centre, ti.static(least_count(radius)), n, sx, sy, sxx, sxy, syy, sw, sxw, syw, sww
    )
    fits[i, block, W0], fits[i, block, WX], fits[i, block, WY] = w0, wx, wy
    fits[i, block, NX], fits[i, block, NY], fits[i, block, NZ] = nx, ny, nz


@lanes_kernel
def fit_planes(
    settings: nd(ti.f32, ndim=1),  # [SETTINGS]
    blocks: nd(Lanes, ndim=2),  # [H // 2 + 2 MARGIN, B + 2] 1/m
    radius: ti.template(),  # blocks, up to MARGIN
    fits: nd(Lanes, ndim=3),  # [H // 2, B, FIT] out
):
    """Fit a plane to the like neighbours of each block."""
    for spread in range(fits.shape[0] * _SPREAD):
        i = spread // _SPREAD
        if spread - i * _SPREAD == 0:
            for block in range(fits.shape[1]):
                fit_16_blocks(settings, blocks, i, block, radius, fits)


@ti.kernel
def spread_normals(
    settings: nd(ti.f32, ndim=1),  # [SETTINGS]
    depth: nd(ti.f32, ndim=2),  # [H, W] m, 0 = none
    fits: nd(ti.f32, ndim=4),  # [H // 2, B, FIT, 16]
    with_depth: ti.template(),
    out: nd(ti.f32, ndim=3),  # [H, W, 3] camera frame, towards the camera, out; with_depth: [H, W, 4], then depth in m
):
    """Give each pixel its block's normal if it lies on the fit; an odd last row or column joins the block before."""
    height, width = depth.shape[0], depth.shape[1]
    rows, columns = height // 2, width // 2
    for s in range(height * SPLIT):
        r, begin, end = segment(s, columns)
        i = ti.min(r >> 1, rows - 1)
        tolerance, off_y = 4.0 * settings[SIGMA], r - (2.0 * i + 0.5)
        for j in range(begin, end):
            block, lane = j >> LANE_BITS, j & (LANES - 1)
            w0, slope = fits[i, block, W0, lane], fits[i, block, WX, lane]
            nx, ny, nz = fits[i, block, NX, lane], fits[i, block, NY, lane], fits[i, block, NZ, lane]
            middle = w0 + fits[i, block, WY, lane] * off_y
            for c in range(2 * j, ti.select(j + 1 < columns, 2 * j + 2, width)):
                z = depth[r, c]
                expected = middle + slope * (c - (2.0 * j + 0.5))
                near = ti.abs(1.0 / ti.max(z, 1e-6) - expected) <= tolerance + 0.01 * w0
                keep = ti.select((z > 0.0) and near, 1.0, 0.0)
                out[r, c, 0] = keep * nx
                out[r, c, 1] = keep * ny
                out[r, c, 2] = keep * nz
                if ti.static(with_depth):
                    out[r, c, MODEL_DEPTH] = ti.select(z > 0.0 and z < FAR_M, z, 0.0)


@ti.kernel
def adopt_normals(
    settings: nd(ti.f32, ndim=1),  # [SETTINGS]
    planes: nd(ti.f32, ndim=2),  # [P, 4] unit normal towards the camera and offset in m of n . x + d = 0, camera frame
    least_cosine: ti.f32,  # between a pixel's normal and that of its plane
    slack_m: ti.f32,  # a pixel's surface is off its plane by no more than this
    sigmas: ti.f32,  # and so many standard deviations of the sensor's depth
    surface: nd(ti.f32, ndim=3),  # [H, W, 4] normal, 0 = none, and depth in m, along which the distance is measured
):
    """Give each pixel the normal of the nearest plane that its surface lies on."""
    for s in range(surface.shape[0] * SPLIT):
        i, begin, end = segment(s, surface.shape[1])
        y = (i - settings[CY]) / settings[FY]
        for j in range(begin, end):
            x, z = (j - settings[CX]) / settings[FX], surface[i, j, MODEL_DEPTH]
            nx, ny, nz = surface[i, j, 0], surface[i, j, 1], surface[i, j, 2]
            nearest, on = slack_m + sigmas * settings[SIGMA] * z * z, -1
            for k in range(planes.shape[0]):
                px, py, pz = planes[k, 0], planes[k, 1], planes[k, 2]
                off = ti.abs(z * (px * x + py * y + pz) + planes[k, 3])
                if off < nearest and nx * px + ny * py + nz * pz > least_cosine:
                    nearest, on = off, k
            if on >= 0:
                for c in ti.static(range(3)):
                    surface[i, j, c] = planes[on, c]
