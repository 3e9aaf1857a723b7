"""The instance field (section 3.3): weights and slopes of E_pgi, relaxation of the embeddings, ids read from colours.

A code is what a plane's id looks like when rendered: a colour of the palette, or a scalar in the first channel. Codes
come as a table with the code of "no plane" in row 0 and that of id k in row k + 1; ids beyond it are on no plane.
"""

import taichi as ti

from tgslam.kernels.objective import charbonnier_root, share
from tgslam.kernels.projection import sigmoid
from tgslam.kernels.warp import WARP, warp_sum

F1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
F3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
I1 = ti.types.ndarray(dtype=ti.i32, ndim=1)
I2 = ti.types.ndarray(dtype=ti.i32, ndim=2)

BLOCK = WARP  # pixels of a row whose sums one writer adds up: a thread on the CPU, a warp under CUDA
EDGE_PX = 2  # a boundary this near makes a pixel an edge
RING = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))
LOW, HIGH = 0.01, 0.99  # colours that embeddings keep to: beyond, the sigmoid has next to no slope


@ti.func
def start_of(block, width):
    """Row and first column of a block of pixels; the last block of a row may end beyond it."""
    per_row = (width + BLOCK - 1) // BLOCK
    i = block // per_row
    return i, (block - i * per_row) * BLOCK


@ti.func
def is_edge(i, j, ids: ti.template(), depth: ti.template()):
    """Whether a measured pixel EDGE_PX away shows another plane; a hole in the depth shows nothing."""
    found = 0
    for step in ti.static(RING):
        y = ti.min(ti.max(i + EDGE_PX * step[0], 0), ids.shape[0] - 1)
        x = ti.min(ti.max(j + EDGE_PX * step[1], 0), ids.shape[1] - 1)
        found |= ti.cast((ids[y, x] != ids[i, j]) and (depth[y, x] > 0.0), ti.i32)
    return found


@ti.func
def weigh_pixel(i, j, ids: ti.template(), depth: ti.template(), edge_boost, weight_none, weight: ti.template()):
    """w_edge of a pixel; returns 1 where it counts, else 0."""
    w = 0.0
    if depth[i, j] > 0.0:
        w = ti.select(ids[i, j] < 0, weight_none, 1.0)
        if is_edge(i, j, ids, depth) != 0:
            w *= 1.0 + edge_boost
    weight[i, j] = w
    return ti.select(w > 0.0, 1.0, 0.0)


@ti.kernel
def weigh_ids(
    ids: I2,  # [H, W] plane of each pixel, -1 = none
    depth: F2,  # [H, W] m, 0 = none
    edge_boost: ti.f32,  # at a boundary weights are 1 + this times as much
    weight_none: ti.f32,  # of a measured pixel on no plane
    weight: F2,  # [H, W] out: w_edge of Eq. 4
    partial: F2,  # [1, blocks] out: pixels that count
):
    """The weights of Eq. 4, once a keyframe."""
    height, width = ids.shape[0], ids.shape[1]
    if ti.static(ti.cfg.arch == ti.cuda):
        for p in range(partial.shape[1] * BLOCK):
            i, first = start_of(p // BLOCK, width)
            j = first + p % BLOCK
            counted = 0.0
            if i < height and j < width:
                counted = weigh_pixel(i, j, ids, depth, edge_boost, weight_none, weight)
            total = warp_sum(counted)
            if p % WARP == 0:
                partial[0, p // WARP] = total
    else:
        for block in range(partial.shape[1]):
            i, first = start_of(block, width)
            total = 0.0
            for j in range(first, ti.min(first + BLOCK, width)):
                total += weigh_pixel(i, j, ids, depth, edge_boost, weight_none, weight)
            partial[0, block] = total


@ti.func
def pixel_slopes(
    i,
    j,
    embedding: ti.template(),
    opacity: ti.template(),
    ids: ti.template(),
    weight: ti.template(),
    code: ti.template(),
    per_pixel,
    epsilon,
    g_embedding: ti.template(),
    g_opacity: ti.template(),
    w_embedding: ti.template(),
):
    """One pixel's part of `pgi_slopes`; returns its penalty before the mean."""
    row = ti.select(ids[i, j] < code.shape[0] - 1, ids[i, j] + 1, 0)
    wanted = ti.Vector([code[row, 0], code[row, 1], code[row, 2]])
    r = ti.Vector([embedding[i, j, 0], embedding[i, j, 1], embedding[i, j, 2]]) - opacity[i, j] * wanted
    root = charbonnier_root(r.norm_sqr(), epsilon)
    per_residual = per_pixel * weight[i, j] / root
    for c in ti.static(range(3)):
        g_embedding[i, j, c] = per_residual * r[c]
    g_opacity[i, j] = g_opacity[i, j] - per_residual * r.dot(wanted)
    w_embedding[i, j] = per_residual
    return weight[i, j] * (root - epsilon)


@ti.kernel
def pgi_slopes(
    embedding: F3,  # [H, W, 3] rendered, Eq. 3
    opacity: F2,  # [H, W] rendered
    ids: I2,  # [H, W]
    weight: F2,  # [H, W] from `weigh_ids`
    counted: F1,  # [1] pixels that count
    code: F2,  # [K, 3] see above
    scale: ti.f32,  # lambda_pgi
    epsilon: ti.f32,  # Charbonnier, colour in [0, 1]
    g_embedding: F3,  # [H, W, 3] out
    g_opacity: F2,  # [H, W] added to
    w_embedding: F2,  # [H, W] out: curvature by a rendered channel (reweighted least squares)
    partial: F2,  # [1, blocks] out: weighted penalties
):
    """E_pgi of Eq. 4 against opacity times the code: what is not covered has no identity, right or wrong."""
    height, width = ids.shape[0], ids.shape[1]
    if ti.static(ti.cfg.arch == ti.cuda):
        for p in range(partial.shape[1] * BLOCK):
            i, first = start_of(p // BLOCK, width)
            j = first + p % BLOCK
            penalty = 0.0
            if i < height and j < width:
                penalty = pixel_slopes(
                    i, j, embedding, opacity, ids, weight, code, share(scale, counted[0]), epsilon,
                    g_embedding, g_opacity, w_embedding,
                )  # fmt: skip
            total = warp_sum(penalty)
            if p % WARP == 0:
                partial[0, p // WARP] = total
    else:
        for block in range(partial.shape[1]):
            i, first = start_of(block, width)
            total = 0.0
            for j in range(first, ti.min(first + BLOCK, width)):
                total += pixel_slopes(
                    i, j, embedding, opacity, ids, weight, code, share(scale, counted[0]), epsilon,
                    g_embedding, g_opacity, w_embedding,
                )  # fmt: skip
            partial[0, block] = total


@ti.kernel
def relax_embeddings(
    count: ti.i32,
    visible: I1,  # [N] 0 = leave the Gaussian alone
    grad_theta: F2,  # [N, 3]
    curvature: F2,  # [N, 2] the second column: sum of blend weight times `w_embedding`
    counted: F1,  # [1] pixels that count
    most_px: F1,  # [N] blend weight in the view that has shown the Gaussian best
    step: ti.f32,  # 1 = the full step
    floor: ti.f32,  # over the pixels that count, it is added to the curvature, so that little evidence moves little
    share_of_most: ti.f32,  # as many such floors as this share of most_px, so that fringes move little, too
    theta: F2,  # [N, 3] changed
):
    """One relaxation step of sigmoid(theta), in which blending is linear: see kernels/relaxation.py."""
    for i in range(count):
        whole = curvature[i, 1] + share(floor, counted[0]) * ti.max(1.0, share_of_most * most_px[i])
        if curvature[i, 1] > 0.0 and visible[i] != 0:
            for c in ti.static(range(3)):
                colour = ti.min(ti.max(sigmoid(theta[i, c]), LOW), HIGH)
                slope = grad_theta[i, c] / (colour * (1.0 - colour))
                moved = ti.min(ti.max(colour - step * slope / whole, LOW), HIGH)
                theta[i, c] = ti.log(moved / (1.0 - moved))


@ti.func
def squared_distance(x, code: ti.template(), k):
    """Between a colour and the code in row k."""
    return (x - ti.Vector([code[k, 0], code[k, 1], code[k, 2]])).norm_sqr()


@ti.func
def nearest_code(x, code: ti.template(), margin):
    """Row of the code nearest to x, and whether every other one is `margin` farther."""
    nearest, best, second = 0, 1e30, 1e30
    for k in range(code.shape[0]):
        square = squared_distance(x, code, k)
        second = ti.min(second, ti.max(square, best))
        nearest = ti.select(square < best, k, nearest)
        best = ti.min(best, square)
    return nearest, ti.sqrt(second) - ti.sqrt(best) >= margin


@ti.func
def read_pixel(
    i,
    j,
    last,
    embedding: ti.template(),
    opacity: ti.template(),
    code: ti.template(),
    id_of: ti.template(),
    clear_square: ti.template(),
    margin,
    min_opacity,
    ids: ti.template(),
):
    """Decode a pixel; returns the row of its code. A code in whose clear radius the colour lies needs no search."""
    row, found = last, -1
    if min_opacity <= opacity[i, j]:
        x = ti.Vector([embedding[i, j, 0], embedding[i, j, 1], embedding[i, j, 2]]) / opacity[i, j]
        if squared_distance(x, code, last) < clear_square[last]:
            found = id_of[last]
        else:
            row, clear = nearest_code(x, code, margin)
            found = ti.select(clear, id_of[row], -1)
    ids[i, j] = found
    return row


@ti.kernel
def read_ids(
    embedding: F3,  # [H, W, 3] rendered
    opacity: F2,  # [H, W] rendered
    code: F2,  # [K, 3]
    id_of: I1,  # [K] the id of each code
    clear_square: F1,  # [K] square of the radius in which every other code is `margin` farther
    margin: ti.f32,
    min_opacity: ti.f32,  # greater than 0
    ids: I2,  # [H, W] out, -1 = none, undecided, or too little opacity
):
    """The id whose code each pixel shows. On the CPU a pixel is first compared with what the one before it showed."""
    height, width = ids.shape[0], ids.shape[1]
    if ti.static(ti.cfg.arch == ti.cuda):
        for i, j in ti.ndrange(height, width):
            read_pixel(i, j, 0, embedding, opacity, code, id_of, clear_square, margin, min_opacity, ids)
    else:
        for block in range(height * ((width + BLOCK - 1) // BLOCK)):
            i, first = start_of(block, width)
            row = 0
            for j in range(first, ti.min(first + BLOCK, width)):
                row = read_pixel(i, j, row, embedding, opacity, code, id_of, clear_square, margin, min_opacity, ids)
