"""Planes in a depth image: moments of cells, labels of pixels, and the sums that planes are fitted from.

A plane is affine in inverse depth: w(u, v) = g0 + gx (u - cx) + gy (v - cy), and a sensor with sigma_z = sigma z^2 has
the same noise, sigma, at every w: least squares of w is the best fit, without weights. The image is cut into square
cells; each parallel iteration has one cell and writes what belongs to it alone. Sums are taken about the cell's
centre, where single precision is enough. Moments are ordered 1, x, y, xx, xy, yy, w, xw, yw, ww.
"""

import taichi as ti

MOMENTS = 10
CANDIDATES = 4  # planes that may meet in a cell
RAW_COUNT, RAW_SQUARES = MOMENTS, MOMENTS + 1  # after the weighted moments: pixels, and their squared residuals
SEGMENT_SUMS = MOMENTS + 2
_WINDOW = 2  # px, of the square that decides between planes that both fit: 5 x 5 pixels
_MIN_ALIKE = 3  # of 8 neighbours
_RIM_WEIGHT = 0.1  # of pixels beside those of other labels: what borders a surface often lies within its tolerance

nd = ti.types.ndarray


@ti.func
def extent(index, cell, columns, height, width):
    """Pixels [top, bottom) x [left, right) of a cell and its centre (x, y); cells at the border may be smaller."""
    top, left = index // columns * cell, index % columns * cell
    middle = 0.5 * (cell - 1)
    return top, ti.min(top + cell, height), left, ti.min(left + cell, width), left + middle, top + middle


@ti.func
def plane_at(planes: ti.template(), k, x, y):
    """Inverse depth of plane k at (x, y) px from the principal point."""
    return planes[k, 0] + planes[k, 1] * x + planes[k, 2] * y


@ti.func
def misfit(inverse: ti.template(), planes: ti.template(), k, u, v, cx, cy):
    """Measured less predicted inverse depth, 1/m, at a pixel with a measurement."""
    return inverse[v, u] - plane_at(planes, k, u - cx, v - cy)


@ti.kernel
def inverse_depth(
    depth: nd(ti.f32, ndim=2),  # [H, W] m, 0 = none
    columns: ti.i32,  # segments of a row, so that threads have enough to share
    inverse: nd(ti.f32, ndim=2),  # [H, W] 1/m, 0 = none, out
):
    """What the kernels below ask for many times."""
    width = depth.shape[1]
    for s in range(depth.shape[0] * columns):
        v, part = s // columns, s % columns
        for u in range(part * width // columns, (part + 1) * width // columns):
            z = depth[v, u]
            inverse[v, u] = ti.select(z > 0.0, 1.0 / z, 0.0)


@ti.kernel
def cell_moments(
    depth: nd(ti.f32, ndim=2),  # [H, W] m, 0 = none
    cell: ti.i32,  # px
    columns: ti.i32,  # cells a row
    moments: nd(ti.f32, ndim=2),  # [C, 10] of px from the cell's centre and of w - reference, out
    reference: nd(ti.f32, ndim=1),  # [C] 1/m, out
    twist: nd(ti.f32, ndim=2),  # [C, 2] sum of squared twists, 1/m^2, and how many, out
):
    """Moments of inverse depth over each cell's measurements, and the twist w00 - w01 - w10 + w11 of 2 x 2 pixels.

    A plane has no twist, nor has a straight step along a row or a column: white noise gives it 4 times its variance.
    """
    for c in range(moments.shape[0]):
        top, bottom, left, right, x0, y0 = extent(c, cell, columns, depth.shape[0], depth.shape[1])
        w0 = 0.0
        sums = ti.Vector([0.0] * MOMENTS)
        squares, twists = 0.0, 0.0
        for v in range(top, bottom):
            y = v - y0
            for u in range(left, right):
                z = depth[v, u]
                if z > 0.0:
                    w0 = ti.select(w0 > 0.0, w0, 1.0 / z)
                    x, w = u - x0, 1.0 / z - w0
                    sums += ti.Vector([1.0, x, y, x * x, x * y, y * y, w, x * w, y * w, w * w])
                    if v + 1 < bottom and u + 1 < right:
                        a, b, d = depth[v, u + 1], depth[v + 1, u], depth[v + 1, u + 1]
                        if a > 0.0 and b > 0.0 and d > 0.0:
                            t = (1.0 / z - 1.0 / a) - (1.0 / b - 1.0 / d)
                            squares += t * t
                            twists += 1.0
        reference[c] = w0
        twist[c, 0] = squares
        twist[c, 1] = twists
        for k in ti.static(range(MOMENTS)):
            moments[c, k] = sums[k]


@ti.kernel
def candidates(
    labels: nd(ti.i32, ndim=2),  # [rows, columns] plane of each cell, -1 = none
    found: nd(ti.i32, ndim=2),  # [C, 4] out, -1 = none
):
    """The planes of a cell and its 8 neighbours, each once, its own and the nearer ones first."""
    rows, columns = labels.shape[0], labels.shape[1]
    for c in range(found.shape[0]):
        i, j = c // columns, c % columns
        planes = ti.Vector([-1] * CANDIDATES)
        count = 0
        for k in ti.static(range(9)):
            # Own cell, sides, corners
            y = ti.static((0, -1, 0, 0, 1, -1, -1, 1, 1)[k])
            x = ti.static((0, 0, -1, 1, 0, -1, 1, -1, 1)[k])
            label = -1
            if 0 <= i + y < rows and 0 <= j + x < columns:
                label = labels[i + y, j + x]
            new = label >= 0 and count < CANDIDATES
            for m in ti.static(range(CANDIDATES)):
                new = new and planes[m] != label
            if new:
                for m in ti.static(range(CANDIDATES)):
                    planes[m] = ti.select(m == count, label, planes[m])
                count += 1
        for m in ti.static(range(CANDIDATES)):
            found[c, m] = planes[m]


@ti.func
def cut_square(inverse: ti.template(), g0, gx, gy, x, y, v, u, tolerance):
    """Squared misfit of the pixel (v, u), which is (x, y) px from the principal point, cut at the tolerance."""
    off = ti.min(ti.abs(inverse[v, u] - (g0 + gx * x + gy * y)), tolerance)
    return ti.select(inverse[v, u] > 0.0, off * off, 0.0)


@ti.func
def window_misfit(inverse: ti.template(), planes: ti.template(), k, u, v, cx, cy, tolerance):
    """Sum of squared misfits about a pixel, each cut at the tolerance."""
    height, width = inverse.shape[0], inverse.shape[1]
    g0, gx, gy = planes[k, 0], planes[k, 1], planes[k, 2]
    total = 0.0
    if _WINDOW <= v < height - _WINDOW and _WINDOW <= u < width - _WINDOW:
        for i, j in ti.static(ti.ndrange((-_WINDOW, _WINDOW + 1), (-_WINDOW, _WINDOW + 1))):
            total += cut_square(inverse, g0, gx, gy, u + j - cx, v + i - cy, v + i, u + j, tolerance)
    else:
        for r in range(ti.max(v - _WINDOW, 0), ti.min(v + _WINDOW + 1, height)):
            for s in range(ti.max(u - _WINDOW, 0), ti.min(u + _WINDOW + 1, width)):
                total += cut_square(inverse, g0, gx, gy, s - cx, r - cy, r, s, tolerance)
    return total


@ti.func
def label_by_one(inverse: ti.template(), planes: ti.template(), k, u, v, cx, cy, tolerance):
    """Plane k, if the pixel is measured and fits it."""
    fits = inverse[v, u] > 0.0 and ti.abs(misfit(inverse, planes, k, u, v, cx, cy)) <= tolerance
    return ti.select(fits, k, -1)


@ti.func
def label_by_several(
    inverse: ti.template(), planes: ti.template(), near: ti.template(), within: ti.template(), u, v, cx, cy
):
    """The one of the planes `near` [4] within the tolerances [4], -1 = none; of several, which the window fits."""
    label, fitting = -1, 0
    if inverse[v, u] > 0.0:
        for m in ti.static(range(CANDIDATES)):
            if near[m] >= 0:
                fits = ti.abs(misfit(inverse, planes, near[m], u, v, cx, cy)) <= within[m]
                fitting += ti.select(fits, 1, 0)
                label = ti.select(fits, near[m], label)
    if fitting > 1:
        least = 1e30
        for m in ti.static(range(CANDIDATES)):
            if near[m] >= 0:
                if ti.abs(misfit(inverse, planes, near[m], u, v, cx, cy)) <= within[m]:
                    total = window_misfit(inverse, planes, near[m], u, v, cx, cy, within[m])
                    if total < least:
                        least = total
                        label = near[m]
    return label


@ti.kernel
def label_pixels(
    inverse: nd(ti.f32, ndim=2),  # [H, W] 1/m, 0 = none
    cx: ti.f32,
    cy: ti.f32,
    cell: ti.i32,  # px
    columns: ti.i32,  # cells a row
    found: nd(ti.i32, ndim=2),  # [C, 4] see `candidates`
    planes: nd(ti.f32, ndim=2),  # [P, 3] g0, gx, gy
    tolerance: nd(ti.f32, ndim=1),  # [P] 1/m
    labels: nd(ti.i32, ndim=2),  # [H, W] out, -1 = none
):
    """Each pixel's plane: that one of the cell's candidates within the tolerance; of several, which its window fits."""
    for c in range(found.shape[0]):
        top, bottom, left, right, _, _ = extent(c, cell, columns, inverse.shape[0], inverse.shape[1])
        near = ti.Vector([-1] * CANDIDATES)
        within = ti.Vector([0.0] * CANDIDATES)
        for m in ti.static(range(CANDIDATES)):
            near[m] = found[c, m]
            if near[m] >= 0:
                within[m] = tolerance[near[m]]
        if near[0] < 0:
            for v in range(top, bottom):
                for u in range(left, right):
                    labels[v, u] = -1
        elif near[1] < 0:  # most cells lie within one plane
            for v in range(top, bottom):
                for u in range(left, right):
                    labels[v, u] = label_by_one(inverse, planes, near[0], u, v, cx, cy, within[0])
        else:
            for v in range(top, bottom):
                for u in range(left, right):
                    labels[v, u] = label_by_several(inverse, planes, near, within, u, v, cx, cy)


@ti.func
def alike(labels: ti.template(), v, u):
    """How many of the 8 pixels around one share its label; those beyond the image are as the nearest ones in it."""
    label, count = labels[v, u], -1  # itself
    for r in ti.static(range(-1, 2)):
        for q in ti.static(range(-1, 2)):
            y, x = ti.min(ti.max(v + r, 0), labels.shape[0] - 1), ti.min(ti.max(u + q, 0), labels.shape[1] - 1)
            count += ti.select(labels[y, x] == label, 1, 0)
    return count


@ti.func
def surrounded(labels: ti.template(), v, u):
    """Whether all 8 pixels around one share its label; those beyond the image are as the nearest ones in it."""
    result = True
    if 0 < v < labels.shape[0] - 1 and 0 < u < labels.shape[1] - 1:
        for r in ti.static(range(-1, 2)):
            for q in ti.static(range(-1, 2)):
                result = result and labels[v + r, u + q] == labels[v, u]
    else:
        result = alike(labels, v, u) == 8
    return result


@ti.kernel
def drop_lonely(
    labels: nd(ti.i32, ndim=2),  # [H, W] -1 = none
    columns: ti.i32,  # segments of a row, so that threads have enough to share
    kept: nd(ti.i32, ndim=2),  # [H, W] out
):
    """Take the label from pixels that hardly a neighbour shares it with."""
    height, width = labels.shape[0], labels.shape[1]
    for s in range(height * columns):
        v, part = s // columns, s % columns
        for u in range(part * width // columns, (part + 1) * width // columns):
            label = labels[v, u]
            if label >= 0 and not surrounded(labels, v, u):
                label = ti.select(alike(labels, v, u) >= _MIN_ALIKE, label, -1)
            kept[v, u] = label


@ti.kernel
def segment_sums(
    inverse: nd(ti.f32, ndim=2),  # [H, W] 1/m, 0 = none
    cx: ti.f32,
    cy: ti.f32,
    cell: ti.i32,  # px
    columns: ti.i32,  # cells a row
    found: nd(ti.i32, ndim=2),  # [C, 4] see `candidates`
    planes: nd(ti.f32, ndim=2),  # [P, 3] g0, gx, gy
    labels: nd(ti.i32, ndim=2),  # [H, W] -1 = none
    scale: ti.f32,  # Charbonnier's epsilon, 1/m
    sums: nd(ti.f32, ndim=3),  # [C, 4, 12] out; x and y in px from the cell's centre, w is the misfit
):
    """Moments of the misfits of each candidate's pixels in each cell, weighted by 1 / sqrt(1 + (misfit / scale)^2).

    Pixels at the rim of a segment weigh less: they may show what is beside it, and turn narrow segments most.
    """
    for c in range(found.shape[0]):
        top, bottom, left, right, x0, y0 = extent(c, cell, columns, inverse.shape[0], inverse.shape[1])
        for m in range(CANDIDATES):
            k = found[c, m]
            total = ti.Vector([0.0] * SEGMENT_SUMS)
            if k >= 0:
                for v in range(top, bottom):
                    y = v - y0
                    for u in range(left, right):
                        if labels[v, u] == k:
                            x, r = u - x0, misfit(inverse, planes, k, u, v, cx, cy)
                            q = 1.0 / ti.sqrt(1.0 + (r / scale) * (r / scale))
                            q *= ti.select(surrounded(labels, v, u), 1.0, _RIM_WEIGHT)
                            total += ti.Vector(
                                [q, q * x, q * y, q * x * x, q * x * y, q * y * y, q * r, q * x * r, q * y * r,
                                 q * r * r, 1.0, r * r]
                            )  # fmt: skip
            for n in ti.static(range(SEGMENT_SUMS)):
                sums[c, m, n] = total[n]
