"""Image kernels: luminance, 2x2 halving, Sobel gradients, the texture gate and normals from depth. CPU form.

A parallel loop of up to 512 iterations runs on one thread, so each row is cut into SPLIT segments of columns.
Every output has one writer.
"""

import taichi as ti

SPLIT = 4  # segments of columns a row: 480 rows give 1920 parallel iterations

F1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
F3 = ti.types.ndarray(dtype=ti.f32, ndim=3)


@ti.func
def segment(index, columns):
    """Row and column range [begin, end) of one parallel iteration."""
    row = index // SPLIT
    part = index - row * SPLIT
    return row, part * columns // SPLIT, (part + 1) * columns // SPLIT


@ti.kernel
def luminance(
    colour: F3,  # [H, W, 3] RGB
    grey: F2,  # [H, W] out
):
    """Luma 0.299 R + 0.587 G + 0.114 B."""
    for s in range(colour.shape[0] * SPLIT):
        i, begin, end = segment(s, colour.shape[1])
        for j in range(begin, end):
            grey[i, j] = 0.299 * colour[i, j, 0] + 0.587 * colour[i, j, 1] + 0.114 * colour[i, j, 2]


@ti.kernel
def halve_grey(
    image: F2,  # [H, W]
    half: F2,  # [H // 2, W // 2] out
):
    """Mean of each 2x2 block."""
    for s in range(half.shape[0] * SPLIT):
        i, begin, end = segment(s, half.shape[1])
        for j in range(begin, end):
            top = image[2 * i, 2 * j] + image[2 * i, 2 * j + 1]
            half[i, j] = 0.25 * (top + image[2 * i + 1, 2 * j] + image[2 * i + 1, 2 * j + 1])


@ti.kernel
def halve_colour(
    image: F3,  # [H, W, 3]
    half: F3,  # [H // 2, W // 2, 3] out
):
    """Mean of each 2x2 block, channel by channel."""
    for s in range(half.shape[0] * SPLIT):
        i, begin, end = segment(s, half.shape[1])
        for j in range(begin, end):
            for c in ti.static(range(3)):
                top = image[2 * i, 2 * j, c] + image[2 * i, 2 * j + 1, c]
                half[i, j, c] = 0.25 * (top + image[2 * i + 1, 2 * j, c] + image[2 * i + 1, 2 * j + 1, c])


@ti.kernel
def halve_depth(
    depth: F2,  # [H, W] m, 0 = none
    relative: ti.f32,  # largest difference from the nearest of the block, as a part of its depth
    half: F2,  # [H // 2, W // 2] m, out
):
    """Mean of the measurements of a 2x2 block that lie on its nearest surface; 0 where the block has none."""
    for s in range(half.shape[0] * SPLIT):
        i, begin, end = segment(s, half.shape[1])
        for j in range(begin, end):
            nearest = 1e30
            for k in ti.static(range(4)):
                z = depth[2 * i + k // 2, 2 * j + k % 2]
                nearest = ti.min(nearest, ti.select(z > 0.0, z, 1e30))
            total = 0.0
            count = 0.0
            for k in ti.static(range(4)):
                z = depth[2 * i + k // 2, 2 * j + k % 2]
                keep = ti.select((z > 0.0) and (z <= nearest * (1.0 + relative)), 1.0, 0.0)
                total += keep * z
                count += keep
            half[i, j] = total / ti.max(count, 1.0)


@ti.func
def sobel_at(image: ti.template(), i, j):
    """Sobel gradient (d/dx, d/dy) per pixel, edges replicated."""
    up, down = ti.max(i - 1, 0), ti.min(i + 1, image.shape[0] - 1)
    left, right = ti.max(j - 1, 0), ti.min(j + 1, image.shape[1] - 1)
    a, b = image[down, right] - image[up, left], image[down, left] - image[up, right]
    gx = 0.125 * (a - b + 2.0 * (image[i, right] - image[i, left]))
    gy = 0.125 * (a + b + 2.0 * (image[down, j] - image[up, j]))
    return gx, gy


@ti.kernel
def sobel(
    image: F2,  # [H, W]
    grad_x: F2,  # [H, W] per px, out
    grad_y: F2,  # [H, W] per px, out
):
    """Sobel gradients divided by 8, so that a ramp of slope s gives s; edges are replicated."""
    for s in range(image.shape[0] * SPLIT):
        i, begin, end = segment(s, image.shape[1])
        for j in range(begin, end):
            gx, gy = sobel_at(image, i, j)
            grad_x[i, j] = gx
            grad_y[i, j] = gy


@ti.kernel
def sobel_magnitude(
    image: F2,  # [H, W]
    magnitude: F2,  # [H, W] per px, out
):
    """Texture strength, Eq. 10."""
    for s in range(image.shape[0] * SPLIT):
        i, begin, end = segment(s, image.shape[1])
        for j in range(begin, end):
            gx, gy = sobel_at(image, i, j)
            magnitude[i, j] = ti.sqrt(gx * gx + gy * gy)


@ti.kernel
def gate(
    magnitude: F2,  # [H, W] per px
    low: ti.f32,  # G_min
    inverse_range: ti.f32,  # 1 / (G_max - G_min + epsilon)
    out: F2,  # [H, W] in [0, 1], out
):
    """Gate of Eq. 11, clipped to [0, 1]: 1 where there is no texture."""
    for s in range(magnitude.shape[0] * SPLIT):
        i, begin, end = segment(s, magnitude.shape[1])
        for j in range(begin, end):
            out[i, j] = 1.0 - ti.min(ti.max((magnitude[i, j] - low) * inverse_range, 0.0), 1.0)


@ti.kernel
def inverse_depth_blocks(
    depth: F2,  # [H, W] m, 0 = none
    relative: ti.f32,
    blocks: F2,  # [H // 2, W // 2] 1/m, 0 = none, out
):
    """Mean inverse depth of the nearest surface in each 2x2 block."""
    for s in range(blocks.shape[0] * SPLIT):
        i, begin, end = segment(s, blocks.shape[1])
        for j in range(begin, end):
            nearest = 0.0
            for k in ti.static(range(4)):
                z = depth[2 * i + k // 2, 2 * j + k % 2]
                nearest = ti.max(nearest, ti.select(z > 0.0, 1.0 / ti.max(z, 1e-6), 0.0))
            total = 0.0
            count = 0.0
            for k in ti.static(range(4)):
                z = depth[2 * i + k // 2, 2 * j + k % 2]
                w = 1.0 / ti.max(z, 1e-6)
                keep = ti.select((z > 0.0) and (w >= nearest * (1.0 - relative)), 1.0, 0.0)
                total += keep * w
                count += keep
            blocks[i, j] = total / ti.max(count, 1.0)


@ti.func
def fit_block(blocks: ti.template(), i, j, radius, noise, slope):
    """Least squares w(x, y) = w0 + wx x + wy y over the like neighbours of block (i, j).

    Returns (w0, wx, wy, mean squared residual), x and y in blocks, w in 1/m; w0 = 0 when there is no fit.
    """
    centre = blocks[i, j]
    n, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    sw, sxw, syw, sww = 0.0, 0.0, 0.0, 0.0
    first, last = ti.max(j - radius, 0), ti.min(j + radius, blocks.shape[1] - 1)
    for r in range(ti.max(i - radius, 0), ti.min(i + radius, blocks.shape[0] - 1) + 1):
        y = ti.cast(r - i, ti.f32)
        row_n, row_x, row_w, row_xw = 0.0, 0.0, 0.0, 0.0
        for c in range(first, last + 1):
            x = ti.cast(c - j, ti.f32)
            w = blocks[r, c]
            d = w - centre
            if w > 0.0 and ti.abs(d) <= noise + slope * centre * ti.max(ti.abs(x), ti.abs(y)):
                row_n += 1.0
                row_x += x
                row_w += d
                row_xw += d * x
                sxx += x * x
                sww += d * d
        n, sx, sy, sw = n + row_n, sx + row_x, sy + row_n * y, sw + row_w
        sxy, syy, sxw, syw = sxy + row_x * y, syy + row_n * y * y, sxw + row_xw, syw + row_w * y
    mean = 1.0 / ti.max(n, 1.0)
    cxx, cxy, cyy = sxx - sx * sx * mean, sxy - sx * sy * mean, syy - sy * sy * mean
    cxw, cyw, cww = sxw - sx * sw * mean, syw - sy * sw * mean, sww - sw * sw * mean
    det = cxx * cyy - cxy * cxy
    result = ti.Vector([0.0, 0.0, 0.0, 0.0])
    enough = ti.cast((2 * radius + 1) * (2 * radius + 1), ti.f32) * 0.3
    if centre > 0.0 and n >= ti.max(enough, 4.0) and det > 1e-3 * cxx * cyy:
        wx, wy = (cyy * cxw - cxy * cyw) / det, (cxx * cyw - cxy * cxw) / det
        w0 = centre + (sw - wx * sx - wy * sy) * mean
        result = ti.Vector([w0, wx, wy, ti.max(cww - wx * cxw - wy * cyw, 0.0) * mean])
    return result


@ti.kernel
def normals(
    depth: F2,  # [H, W] m, 0 = none
    blocks: F2,  # [H // 2, W // 2] 1/m
    fx: ti.f32,
    fy: ti.f32,
    cx: ti.f32,
    cy: ti.f32,
    radius: ti.i32,  # blocks
    sigma: ti.f32,  # standard deviation of inverse depth, 1/m
    steepest: ti.f32,  # tangent of the largest angle between normal and optical axis that may be joined
    out: F3,  # [H, W, 3] camera frame, towards the camera, out
):
    """Normals from plane fits of inverse depth, one fit a 2x2 block, given to the pixels that lie on the fit."""
    for s in range(blocks.shape[0] * SPLIT):
        i, begin, end = segment(s, blocks.shape[1])
        slope = 2.0 * steepest / ti.min(fx, fy)
        for j in range(begin, end):
            fit = fit_block(blocks, i, j, radius, 4.0 * sigma, slope)
            w0, a, b = fit[0], 0.5 * fit[1], 0.5 * fit[2]  # per pixel from here on
            u, v = 2.0 * j + 0.5, 2.0 * i + 0.5
            nx, ny, nz = a * fx, b * fy, w0 - a * (u - cx) - b * (v - cy)
            length = ti.sqrt(nx * nx + ny * ny + nz * nz)
            good = (w0 > 0.0) and (fit[3] <= 4.0 * sigma * sigma + 1e-5 * w0 * w0)
            for r in range(2 * i, ti.select(i + 1 < blocks.shape[0], 2 * i + 2, depth.shape[0])):
                for c in range(2 * j, ti.select(j + 1 < blocks.shape[1], 2 * j + 2, depth.shape[1])):
                    z = depth[r, c]
                    expected = w0 + a * (c - u) + b * (r - v)
                    near = ti.abs(1.0 / ti.max(z, 1e-6) - expected) <= 4.0 * sigma + 0.01 * w0
                    scale = ti.select(good and (z > 0.0) and near, -1.0 / ti.max(length, 1e-12), 0.0)
                    out[r, c, 0] = nx * scale
                    out[r, c, 1] = ny * scale
                    out[r, c, 2] = nz * scale
