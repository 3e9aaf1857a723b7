"""Image kernels: luminance, 2x2 halving, Sobel gradients, the texture gate, records for alignment.

A parallel loop of up to 512 iterations runs on one thread, so each row is cut into SPLIT segments of columns.
Every output has one writer.
"""

import taichi as ti

from tgslam.kernels.alignment import (
    GREY,
    GX,
    GXX,
    GXY,
    GY,
    GYY,
    LIVE_DEPTH,
    LIVE_GREY,
    LIVE_GX,
    LIVE_GY,
    LIVE_STRENGTH,
    MODEL_DEPTH,
)
from tgslam.kernels.simd import LANES

SPLIT = 4  # segments of columns a row: 480 rows give 1920 parallel iterations
FAR_M = 1e3  # depth beyond is no measurement: what takes no part in alignment must be finite all the same

F1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
F3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
F4 = ti.types.ndarray(dtype=ti.f32, ndim=4)


@ti.func
def segment(index, columns):
    """Row and column range [begin, end) of one parallel iteration."""
    row = index // SPLIT
    part = index - row * SPLIT
    return row, part * columns // SPLIT, (part + 1) * columns // SPLIT


@ti.func
def luma(colour: ti.template(), i, j):
    """Luma of a pixel, 0.299 R + 0.587 G + 0.114 B."""
    return 0.299 * colour[i, j, 0] + 0.587 * colour[i, j, 1] + 0.114 * colour[i, j, 2]


@ti.func
def mean_luma(colour: ti.template(), i, j, size: ti.template()):
    """Mean luma of the block (i, j) of size x size pixels."""
    total = 0.0
    for k in ti.static(range(size * size)):
        total += luma(colour, size * i + k // size, size * j + k % size)
    return total * (1.0 / (size * size))


@ti.func
def mean_of_nearest(z, relative):
    """Mean of those measurements of a vector (m, 0 = none) that lie on its nearest surface; 0 where it has none.

    It is the inverse depth that is averaged, which on a plane is that of the centre: slanted surfaces do not recede.
    """
    nearest = 1e30
    for k in ti.static(range(z.n)):
        nearest = ti.min(nearest, ti.select(z[k] > 0.0, z[k], 1e30))
    total, count = 0.0, 0.0
    for k in ti.static(range(z.n)):
        keep = ti.select((z[k] > 0.0) and (z[k] <= nearest * (1.0 + relative)), 1.0, 0.0)
        total += keep / ti.max(z[k], 1e-6)
        count += keep
    return count / ti.max(total, 1e-9)


@ti.func
def depth_block(depth: ti.template(), i, j, size: ti.template()):
    """The measurements of the block (i, j) of size x size pixels as a vector."""
    z = ti.Vector([0.0] * (size * size))
    for k in ti.static(range(size * size)):
        z[k] = depth[size * i + k // size, size * j + k % size]
    return z


@ti.kernel
def luminance(
    colour: F3,  # [H, W, 3] RGB
    grey: F2,  # [H, W] out
):
    """Luma 0.299 R + 0.587 G + 0.114 B."""
    for s in range(colour.shape[0] * SPLIT):
        i, begin, end = segment(s, colour.shape[1])
        for j in range(begin, end):
            grey[i, j] = luma(colour, i, j)


@ti.kernel
def reduce_frame(
    colour: F3,  # [H, W, 3] RGB
    depth: F2,  # [H, W] m, 0 = none
    size: ti.template(),  # 1 or 2: pixels that become one, either way
    relative: ti.f32,
    grey: F2,  # [H // size, W // size] out
    reduced: F2,  # [H // size, W // size] m, out
):
    """Luminance and depth of a frame, as it is or halved."""
    for s in range(grey.shape[0] * SPLIT):
        i, begin, end = segment(s, grey.shape[1])
        for j in range(begin, end):
            grey[i, j] = mean_luma(colour, i, j, size)
            reduced[i, j] = mean_of_nearest(depth_block(depth, i, j, size), relative)


@ti.kernel
def reduce_rendering(
    colour: F3,  # [H, W, 3] RGB
    depth: F2,  # [H, W] m, accumulated
    opacity: F2,  # [H, W]
    min_opacity: ti.f32,  # pixels of less have no depth
    size: ti.template(),  # 1 or 2: pixels that become one, either way
    relative: ti.f32,
    grey: F2,  # [H // size, W // size] out
    reduced: F2,  # [H // size, W // size] m, out
    cover: F2,  # [H // size, W // size] mean opacity, out
):
    """Luminance, depth and opacity of a rendering, as it is or halved.

    Colours are fitted over black, and are not divided.
    """
    for s in range(grey.shape[0] * SPLIT):
        i, begin, end = segment(s, grey.shape[1])
        for j in range(begin, end):
            grey[i, j] = mean_luma(colour, i, j, size)
            z, covered = depth_block(depth, i, j, size), depth_block(opacity, i, j, size)
            for k in ti.static(range(z.n)):
                z[k] = ti.select(covered[k] > min_opacity, z[k] / ti.max(covered[k], min_opacity), 0.0)
            reduced[i, j] = mean_of_nearest(z, relative)
            cover[i, j] = covered.sum() * (1.0 / (size * size))


@ti.kernel
def halve_pair(
    grey: F2,  # [H, W]
    depth: F2,  # [H, W] m, 0 = none
    relative: ti.f32,
    half_grey: F2,  # [H // 2, W // 2] out
    half_depth: F2,  # [H // 2, W // 2] m, out
):
    """`halve_grey` and `halve_depth` in one pass."""
    for s in range(half_grey.shape[0] * SPLIT):
        i, begin, end = segment(s, half_grey.shape[1])
        for j in range(begin, end):
            half_grey[i, j] = block_mean(grey, i, j)
            half_depth[i, j] = mean_of_nearest(depth_block(depth, i, j, 2), relative)


@ti.func
def block_mean(image: ti.template(), i, j):
    """Mean of the 2x2 block (i, j)."""
    top = image[2 * i, 2 * j] + image[2 * i, 2 * j + 1]
    return 0.25 * (top + image[2 * i + 1, 2 * j] + image[2 * i + 1, 2 * j + 1])


@ti.kernel
def halve_grey(
    image: F2,  # [H, W]
    half: F2,  # [H // 2, W // 2] out
):
    """Mean of each 2x2 block."""
    for s in range(half.shape[0] * SPLIT):
        i, begin, end = segment(s, half.shape[1])
        for j in range(begin, end):
            half[i, j] = block_mean(image, i, j)


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
            half[i, j] = mean_of_nearest(depth_block(depth, i, j, 2), relative)


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
def pack_live(
    grey: F2,  # [H, W]
    depth: F2,  # [H, W] m, 0 = none
    live: F4,  # [H, B, LIVE, 16] out, B = ceil(W / 16); beyond the image there is no depth
):
    """What alignment needs of a live frame, in blocks of 16 pixels."""
    height, width = grey.shape[0], grey.shape[1]
    for s in range(height * SPLIT):
        i, begin, end = segment(s, live.shape[1])
        for block in range(begin, end):
            for lane in range(LANES):
                j = block * LANES + lane
                inside = ti.min(j, width - 1)
                z = depth[i, inside]
                gx, gy = sobel_at(grey, i, inside)
                live[i, block, LIVE_DEPTH, lane] = ti.select(j < width and z > 0.0 and z < FAR_M, z, 0.0)
                live[i, block, LIVE_GREY, lane] = grey[i, inside]
                live[i, block, LIVE_GX, lane] = gx
                live[i, block, LIVE_GY, lane] = gy
                live[i, block, LIVE_STRENGTH, lane] = ti.sqrt(gx * gx + gy * gy)


@ti.kernel
def sample_strength(
    live: F4,  # [H, B, LIVE, 16]
    step: ti.i32,  # px
    sample: F2,  # [ceil(H / step), ceil(W / step)] out
):
    """Every `step`-th pixel's gradient magnitude."""
    for i in range(sample.shape[0]):
        for j in range(sample.shape[1]):
            x = j * step
            sample[i, j] = live[i * step, x // LANES, LIVE_STRENGTH, x % LANES]


@ti.kernel
def sample_grid(
    image: F2,  # [H, W]
    step: ti.i32,  # px
    sample: F2,  # [ceil(H / step), ceil(W / step)] out
):
    """Every `step`-th pixel, either way."""
    for i in range(sample.shape[0]):
        for j in range(sample.shape[1]):
            sample[i, j] = image[i * step, j * step]


@ti.kernel
def pack_texture(
    grey: F2,  # [H, W]
    texture: F3,  # [H, W, TEXTURE] out: all but the second derivatives
):
    """Intensity and its gradient as alignment reads them."""
    for s in range(grey.shape[0] * SPLIT):
        i, begin, end = segment(s, grey.shape[1])
        for j in range(begin, end):
            gx, gy = sobel_at(grey, i, j)
            texture[i, j, GREY] = grey[i, j]
            texture[i, j, GX] = gx
            texture[i, j, GY] = gy


@ti.kernel
def pack_second_derivatives(
    texture: F3,  # [H, W, TEXTURE]
):
    """The gradient's own gradient, from the texture's gradient."""
    height, width = texture.shape[0], texture.shape[1]
    for s in range(height * SPLIT):
        i, begin, end = segment(s, width)
        up, down = ti.max(i - 1, 0), ti.min(i + 1, height - 1)
        for j in range(begin, end):
            left, right = ti.max(j - 1, 0), ti.min(j + 1, width - 1)
            a, b = texture[down, right, GX] - texture[up, left, GX], texture[down, left, GX] - texture[up, right, GX]
            texture[i, j, GXX] = 0.125 * (a - b + 2.0 * (texture[i, right, GX] - texture[i, left, GX]))
            texture[i, j, GXY] = 0.125 * (a + b + 2.0 * (texture[down, j, GX] - texture[up, j, GX]))
            c, d = texture[down, right, GY] - texture[up, left, GY], texture[down, left, GY] - texture[up, right, GY]
            texture[i, j, GYY] = 0.125 * (c + d + 2.0 * (texture[down, j, GY] - texture[up, j, GY]))


@ti.func
def mean_around(image: ti.template(), i, j):
    """Mean of the pixel and those beside it."""
    up, down = ti.max(i - 1, 0), ti.min(i + 1, image.shape[0] - 1)
    left, right = ti.max(j - 1, 0), ti.min(j + 1, image.shape[1] - 1)
    total = image[up, left] + image[up, j] + image[up, right]
    total += image[i, left] + image[i, j] + image[i, right]
    total += image[down, left] + image[down, j] + image[down, right]
    return total * (1.0 / 9.0)


@ti.kernel
def mark_rims(
    half_cover: F2,  # [H // 2, W // 2] opacity
    whole: ti.f32,  # opacity of what is no rim
    surface: F3,  # [H, W, SURFACE]
):
    """Negative depth where the 3x3 blocks of 2x2 pixels round a pixel are covered less than that in the mean."""
    for s in range(surface.shape[0] * SPLIT):
        i, begin, end = segment(s, surface.shape[1])
        row = ti.min(i // 2, half_cover.shape[0] - 1)
        for j in range(begin, end):
            column = ti.min(j // 2, half_cover.shape[1] - 1)
            if mean_around(half_cover, row, column) < whole:
                surface[i, j, MODEL_DEPTH] = -surface[i, j, MODEL_DEPTH]


@ti.kernel
def mark_saturated(
    half_cover: F2,  # [H // 2, W // 2] share that is not saturated
    whole: ti.f32,
    live: F4,  # [H, B, LIVE, 16], B = ceil(W / 16)
):
    """Negative strength where the 3x3 blocks of 2x2 pixels round a pixel hold less than that in the mean."""
    for s in range(live.shape[0] * SPLIT):
        i, begin, end = segment(s, live.shape[1])
        row = ti.min(i // 2, half_cover.shape[0] - 1)
        for block in range(begin, end):
            for lane in range(LANES):
                column = ti.min((block * LANES + lane) // 2, half_cover.shape[1] - 1)
                if mean_around(half_cover, row, column) < whole:
                    live[i, block, LIVE_STRENGTH, lane] = -1.0


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
