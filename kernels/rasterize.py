"""Tile lists, forward and backward rasterization on the CPU, 16 pixels at a time.

A tile's 16x16 pixels are 16 chunks of 4x4; the 16 lanes are a chunk's pixels. A slot is a splat in a tile, in depth
order. `pack_slots` finds per slot the chunks that its alpha >= 1/255 ellipse touches, as a 16-bit mask, and copies the
splat's row next to its neighbours in depth. The forward pass compresses a tile's slots into a list per chunk without a
branch; the backward pass goes splat by splat over the set bits of its mask. Loop bodies are straight-line so that LLVM
packs the lanes into vector registers; accumulators that many live at once stay in memory, since stores are what its
vectorizer starts from. Every output has one writer, so results repeat bit for bit.

Two-dimensional vector arrays throughout: a one-dimensional one is loaded as a gather.
"""

import taichi as ti

from tgslam.kernels.image import SPLIT, segment
from tgslam.kernels.projection import (
    CURVATURE_COLOUR,
    CURVATURE_DEPTH,
    EMBEDDING,
    OPACITY,
    QA,
    QB,
    QC,
    RED,
    SPLAT,
    SPLAT_GRAD,
    ZU,
    ZV,
    U,
    V,
    Z,
)
from tgslam.kernels.simd import (
    ALPHA_MAX,
    ALPHA_MIN,
    CHUNK,
    CHUNKS,
    LANES,
    PER_ROW,
    SPREAD,
    T_MIN,
    TILE,
    LaneBits,
    Lanes,
    exp_neg,
)

nd = ti.types.ndarray

# Rows of the forward result per chunk
OUT_COLOUR, OUT_DEPTH, OUT_EMBEDDING, OUT_T = 0, 3, 4, 7
OUT = 8
# Rows of the pixel gradient per chunk
G_COLOUR, G_DEPTH, G_OPACITY, G_TOTAL, G_EMBEDDING, W_COLOUR, W_DEPTH = 0, 3, 4, 5, 6, 9, 10
G = 11
# Rows of the lane accumulators: like a gradient row, with moments of h = alpha dL/dalpha where u .. opacity go
ACC_H, ACC_X, ACC_Y, ACC_XX, ACC_XY, ACC_YY = 0, 1, 2, 3, 4, 5
ACC_SLOPE = SPLAT_GRAD  # and one more: the gradient by the slope term of the depth
ACC = SPLAT_GRAD + 1


@ti.kernel
def count_slots(
    count: ti.i32,
    tile_rect: nd(ti.i32, ndim=2),  # [N, 4]
    tiles_x: ti.i32,
    per_tile: nd(ti.i32, ndim=1),  # [tiles] zeroed, added to
):
    """How many splats touch each tile (integer atomics: the sum does not depend on the order)."""
    for i in range(count):
        for ty in range(tile_rect[i, 2], tile_rect[i, 3] + 1):
            for tx in range(tile_rect[i, 0], tile_rect[i, 1] + 1):
                per_tile[ty * tiles_x + tx] += 1


@ti.kernel
def fill_slots(
    order: nd(ti.i32, ndim=1),  # [visible] Gaussian indices by depth, ties by index
    visible: ti.i32,
    tile_rect: nd(ti.i32, ndim=2),  # [N, 4]
    tiles_x: ti.i32,
    cursor: nd(ti.i32, ndim=1),  # [tiles] first slot of each tile; advanced
    first_of: nd(ti.i32, ndim=1),  # [N] first entry of a Gaussian in slots_of
    slots_of: nd(ti.i32, ndim=1),  # [slots] out: a Gaussian's slots
    ids: nd(ti.i32, ndim=1),  # [slots] out: the Gaussian of each slot
):
    """Scatter in depth order, serially: the lists come out sorted with no sort per tile."""
    ti.loop_config(serialize=True)
    for o in range(visible):
        i = order[o]
        entry = first_of[i]
        for ty in range(tile_rect[i, 2], tile_rect[i, 3] + 1):
            for tx in range(tile_rect[i, 0], tile_rect[i, 1] + 1):
                slot = cursor[ty * tiles_x + tx]
                cursor[ty * tiles_x + tx] = slot + 1
                ids[slot] = i
                slots_of[entry] = slot
                entry += 1


@ti.kernel
def pack_slots(
    tiles: ti.i32,
    tiles_x: ti.i32,
    start: nd(ti.i32, ndim=1),  # [tiles + 1]
    ids: nd(ti.i32, ndim=1),  # [slots]
    splat: nd(ti.f32, ndim=2),  # [N, SPLAT]
    slot: nd(ti.f32, ndim=2),  # [slots, SPLAT] out, u and v relative to the tile
    mask: nd(ti.i32, ndim=1),  # [slots] out: bit c = the splat reaches chunk c
):
    """Copy splat rows into slot order and find the chunks each reaches; the lanes are the 16 chunks."""
    for spread in range(tiles * SPREAD):
        tile = spread // SPREAD
        if spread - tile * SPREAD == 0:
            x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
            for k in range(start[tile], start[tile + 1]):
                i = ids[k]
                for c in ti.static(range(SPLAT)):
                    slot[k, c] = splat[i, c]
                u, v = splat[i, U] - x0, splat[i, V] - y0
                slot[k, U], slot[k, V] = u, v
                a, b, c_ = splat[i, QA], splat[i, QB], splat[i, QC]
                reach = ti.log(ti.max(splat[i, OPACITY] / ALPHA_MIN, 1.0)) * 1.0001 + 1e-5
                slope_y, slope_x = -b / (2.0 * c_), -b / (2.0 * a)
                hit = LaneBits(0)
                for j in ti.static(range(LANES)):
                    xa, ya = (j % PER_ROW) * CHUNK - u, (j // PER_ROW) * CHUNK - v
                    xb, yb = xa + (CHUNK - 1), ya + (CHUNK - 1)
                    xn, yn = (
                        ti.min(ti.max(0.0, xa), xb),
                        ti.min(ti.max(0.0, ya), yb),
                    )  # chunk lines nearest to the centre
                    y1, x1 = ti.min(ti.max(slope_y * xn, ya), yb), ti.min(ti.max(slope_x * yn, xa), xb)
                    q = ti.min((a * xn + b * y1) * xn + c_ * y1 * y1, (a * x1 + b * yn) * x1 + c_ * yn * yn)
                    hit[j] = ti.select(q <= reach, 1 << j, 0)
                mask[k] = hit.sum()


@ti.kernel
def forward(
    tiles: ti.i32,
    start: nd(ti.i32, ndim=1),  # [tiles + 1]
    slot: nd(ti.f32, ndim=2),  # [slots, SPLAT]
    mask: nd(ti.i32, ndim=1),  # [slots]; bits of splats behind an opaque chunk are cleared
    todo: nd(ti.i32, ndim=1),  # [slots] scratch: one list a tile, reused for each chunk
    with_embedding: ti.template(),
    out: nd(Lanes, ndim=2),  # [tiles * CHUNKS, OUT] out: sums of weight times channel, and the transmittance left
):
    """Alpha blending front to back: colour, depth, embedding colour, transmittance.

    A splat's depth at a pixel is that of its tangent plane. Inverse depth is affine on a plane, so with s the offset
    times the slope, depth is z / (1 - s / z), here to second order: z + s + s^2 / z. To first order alone, surfaces at
    grazing angles come out too near by about one sigma of the sensor, which turns and shifts a tracked camera.
    """
    for spread in range(tiles * SPREAD):
        tile = spread // SPREAD
        if spread - tile * SPREAD == 0:
            first = start[tile]
            for chunk in range(CHUNKS):
                n = 0
                for k in range(first, start[tile + 1]):
                    todo[first + n] = k
                    n += (mask[k] >> chunk) & 1
                cx, cy = ti.cast((chunk % PER_ROW) * CHUNK, ti.f32), ti.cast((chunk // PER_ROW) * CHUNK, ti.f32)
                T, r, g, b, d = Lanes(1.0), Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0)
                e0, e1, e2 = Lanes(0.0), Lanes(0.0), Lanes(0.0)
                m, done = 0, n
                while m < done:
                    k = todo[first + m]
                    dx0, dy0 = cx - slot[k, U], cy - slot[k, V]
                    qa, qb, qc, op = slot[k, QA], slot[k, QB], slot[k, QC], slot[k, OPACITY]
                    z, zu, zv = slot[k, Z], slot[k, ZU], slot[k, ZV]
                    inv_z = 1.0 / z
                    c0, c1, c2 = slot[k, RED], slot[k, RED + 1], slot[k, RED + 2]
                    for j in ti.static(range(LANES)):
                        dx, dy = dx0 + (j % CHUNK), dy0 + (j // CHUNK)
                        alpha = ti.min(ALPHA_MAX, op * exp_neg((qa * dx + qb * dy) * dx + qc * dy * dy))
                        alpha = ti.select(alpha > ALPHA_MIN, alpha, 0.0)
                        w = T[j] * alpha
                        r[j] += w * c0
                        g[j] += w * c1
                        b[j] += w * c2
                        s = zu * dx + zv * dy
                        d[j] += w * (z + s * (1.0 + s * inv_z))
                        if ti.static(with_embedding):
                            e0[j] += w * slot[k, EMBEDDING]
                            e1[j] += w * slot[k, EMBEDDING + 1]
                            e2[j] += w * slot[k, EMBEDDING + 2]
                        T[j] -= w
                    m += 1
                    if (m & 7) == 0:
                        if T.max() < T_MIN:
                            done = m
                for rest in range(done, n):
                    mask[todo[first + rest]] &= ~(1 << chunk)
                row = tile * CHUNKS + chunk
                out[row, OUT_COLOUR], out[row, OUT_COLOUR + 1], out[row, OUT_COLOUR + 2] = r, g, b
                out[row, OUT_DEPTH], out[row, OUT_T] = d, T
                if ti.static(with_embedding):
                    out[row, OUT_EMBEDDING], out[row, OUT_EMBEDDING + 1], out[row, OUT_EMBEDDING + 2] = e0, e1, e2


@ti.kernel
def unpack_image(
    out: nd(ti.f32, ndim=3),  # [tiles * CHUNKS, OUT, LANES]
    tiles_x: ti.i32,
    with_embedding: ti.template(),
    colour: nd(ti.f32, ndim=3),  # [H, W, 3] out
    depth: nd(ti.f32, ndim=2),  # [H, W] out, m, sum of weight times depth
    opacity: nd(ti.f32, ndim=2),  # [H, W] out
    embedding: nd(ti.f32, ndim=3),  # [H, W, 3] out
):
    """Chunk layout -> images."""
    for s in range(colour.shape[0] * SPLIT):
        y, begin, end = segment(s, colour.shape[1])
        for x in range(begin, end):
            row = ((y >> 4) * tiles_x + (x >> 4)) * CHUNKS + ((y >> 2) & 3) * PER_ROW + ((x >> 2) & 3)
            j = (y & 3) * CHUNK + (x & 3)
            for c in ti.static(range(3)):
                colour[y, x, c] = out[row, OUT_COLOUR + c, j]
            depth[y, x] = out[row, OUT_DEPTH, j]
            opacity[y, x] = 1.0 - out[row, OUT_T, j]
            if ti.static(with_embedding):
                for c in ti.static(range(3)):
                    embedding[y, x, c] = out[row, OUT_EMBEDDING + c, j]


@ti.kernel
def pack_gradient(
    out: nd(ti.f32, ndim=3),  # [tiles * CHUNKS, OUT, LANES] of the forward pass
    tiles_x: ti.i32,
    height: ti.i32,
    width: ti.i32,
    with_embedding: ti.template(),
    with_curvature: ti.template(),
    g_colour: nd(ti.f32, ndim=3),  # [H, W, 3] dL/dcolour
    g_depth: nd(ti.f32, ndim=2),  # [H, W] dL/d(sum of weight times depth)
    g_opacity: nd(ti.f32, ndim=2),  # [H, W]
    g_embedding: nd(ti.f32, ndim=3),  # [H, W, 3]
    w_colour: nd(ti.f32, ndim=2),  # [H, W] second derivative of the loss in a colour channel
    w_depth: nd(ti.f32, ndim=2),  # [H, W] second derivative of the loss in depth, 1/m^2
    g: nd(ti.f32, ndim=3),  # [tiles * CHUNKS, G, LANES] out
):
    """Image gradients -> chunk layout, with g . out per pixel; pixels beyond the image get zero."""
    for row in range(g.shape[0]):
        tile, chunk = row // CHUNKS, row % CHUNKS
        x0 = (tile % tiles_x) * TILE + (chunk % PER_ROW) * CHUNK
        y0 = (tile // tiles_x) * TILE + (chunk // PER_ROW) * CHUNK
        for j in range(LANES):
            x, y = x0 + (j & 3), y0 + (j >> 2)
            inside = x < width and y < height
            total = 0.0
            if inside:
                for c in ti.static(range(3)):
                    g[row, G_COLOUR + c, j] = g_colour[y, x, c]
                    total += g_colour[y, x, c] * out[row, OUT_COLOUR + c, j]
                g[row, G_DEPTH, j] = g_depth[y, x]
                g[row, G_OPACITY, j] = g_opacity[y, x]
                total += g_depth[y, x] * out[row, OUT_DEPTH, j] + g_opacity[y, x] * (1.0 - out[row, OUT_T, j])
                if ti.static(with_embedding):
                    for c in ti.static(range(3)):
                        g[row, G_EMBEDDING + c, j] = g_embedding[y, x, c]
                        total += g_embedding[y, x, c] * out[row, OUT_EMBEDDING + c, j]
                if ti.static(with_curvature):
                    g[row, W_COLOUR, j], g[row, W_DEPTH, j] = w_colour[y, x], w_depth[y, x]
            else:
                for c in ti.static(range(G)):
                    g[row, c, j] = 0.0
            g[row, G_TOTAL, j] = total


@ti.kernel
def backward(
    tiles: ti.i32,
    start: nd(ti.i32, ndim=1),  # [tiles + 1]
    slot: nd(ti.f32, ndim=2),  # [slots, SPLAT]
    mask: nd(ti.i32, ndim=1),  # [slots] as the forward pass left it
    origin: nd(ti.f32, ndim=2),  # [CHUNKS, 2] px: a table, since `%` and `//` cost some 15 instructions
    g: nd(Lanes, ndim=2),  # [tiles * CHUNKS, G]
    with_embedding: ti.template(),
    with_curvature: ti.template(),
    state: nd(Lanes, ndim=2),  # [tiles * CHUNKS, 2] scratch: transmittance and prefix sum of weight times g . c
    acc: nd(Lanes, ndim=2),  # [tiles, ACC] scratch
    slot_grad: nd(ti.f32, ndim=2),  # [slots, SPLAT_GRAD] out
):
    """Gradient of every slot, splat by splat over its chunks; nothing of the forward pass is stored but the image.

    dL/dalpha_i = T_i (g . c_i) - (g . out - sum_{k <= i} w_k g . c_k) / (1 - alpha_i), zero where alpha saturates.
    """
    for spread in range(tiles * SPREAD):
        tile = spread // SPREAD
        if spread - tile * SPREAD == 0:
            for chunk in range(CHUNKS):
                state[tile * CHUNKS + chunk, 0], state[tile * CHUNKS + chunk, 1] = Lanes(1.0), Lanes(0.0)
            for k in range(start[tile], start[tile + 1]):
                u, v, qa, qb, qc, op = slot[k, U], slot[k, V], slot[k, QA], slot[k, QB], slot[k, QC], slot[k, OPACITY]
                z, zu, zv = slot[k, Z], slot[k, ZU], slot[k, ZV]
                inv_z = 1.0 / z
                c0, c1, c2 = slot[k, RED], slot[k, RED + 1], slot[k, RED + 2]
                for c in ti.static(range(ACC)):
                    acc[tile, c] = Lanes(0.0)
                bits = mask[k]
                while bits != 0:
                    lowest = bits & (-bits)
                    bits ^= lowest
                    chunk = 31 - ti.math.clz(lowest)
                    row = tile * CHUNKS + chunk
                    dx0, dy0 = origin[chunk, 0] - u, origin[chunk, 1] - v
                    T, A, total = state[row, 0], state[row, 1], g[row, G_TOTAL]
                    g0, g1, g2, gd, go = g[row, 0], g[row, 1], g[row, 2], g[row, G_DEPTH], g[row, G_OPACITY]
                    ge0, ge1, ge2 = g[row, G_EMBEDDING], g[row, G_EMBEDDING + 1], g[row, G_EMBEDDING + 2]
                    wc, wd = g[row, W_COLOUR], g[row, W_DEPTH]
                    a0, a1, a2 = acc[tile, RED], acc[tile, RED + 1], acc[tile, RED + 2]
                    az, azu, azv, as_ = acc[tile, Z], acc[tile, ZU], acc[tile, ZV], acc[tile, ACC_SLOPE]
                    ae0, ae1, ae2 = acc[tile, EMBEDDING], acc[tile, EMBEDDING + 1], acc[tile, EMBEDDING + 2]
                    ac, ad = acc[tile, CURVATURE_COLOUR], acc[tile, CURVATURE_DEPTH]
                    m, mx, my = acc[tile, ACC_H], acc[tile, ACC_X], acc[tile, ACC_Y]
                    mxx, mxy, myy = acc[tile, ACC_XX], acc[tile, ACC_XY], acc[tile, ACC_YY]
                    for j in ti.static(range(LANES)):
                        dx, dy = dx0 + (j % CHUNK), dy0 + (j // CHUNK)
                        raw = op * exp_neg((qa * dx + qb * dy) * dx + qc * dy * dy)
                        alpha = ti.min(ALPHA_MAX, raw)
                        alpha = ti.select(alpha > ALPHA_MIN, alpha, 0.0)
                        w = T[j] * alpha
                        s = zu * dx + zv * dy
                        gc = g0[j] * c0 + g1[j] * c1 + g2[j] * c2 + gd[j] * (z + s * (1.0 + s * inv_z)) + go[j]
                        if ti.static(with_embedding):
                            gc += ge0[j] * slot[k, EMBEDDING] + ge1[j] * slot[k, EMBEDDING + 1]
                            gc += ge2[j] * slot[k, EMBEDDING + 2]
                        prefix = A[j] + w * gc
                        h = (T[j] * gc - (total[j] - prefix) / (1.0 - alpha)) * alpha
                        h = ti.select(raw < ALPHA_MAX, h, 0.0)
                        T[j] -= w
                        A[j] = prefix
                        a0[j] += w * g0[j]
                        a1[j] += w * g1[j]
                        a2[j] += w * g2[j]
                        wg = w * gd[j]
                        bend = s * inv_z
                        az[j] += wg * (1.0 - bend * bend)
                        ws = wg * (1.0 + 2.0 * bend)
                        as_[j] += ws
                        azu[j] += ws * dx
                        azv[j] += ws * dy
                        if ti.static(with_embedding):
                            ae0[j] += w * ge0[j]
                            ae1[j] += w * ge1[j]
                            ae2[j] += w * ge2[j]
                        if ti.static(with_curvature):
                            ac[j] += w * wc[j]
                            ad[j] += w * wd[j]
                        hx, hy = h * dx, h * dy
                        m[j] += h
                        mx[j] += hx
                        my[j] += hy
                        mxx[j] += hx * dx
                        mxy[j] += hx * dy
                        myy[j] += hy * dy
                    state[row, 0], state[row, 1] = T, A
                    acc[tile, RED], acc[tile, RED + 1], acc[tile, RED + 2] = a0, a1, a2
                    acc[tile, Z], acc[tile, ZU], acc[tile, ZV], acc[tile, ACC_SLOPE] = az, azu, azv, as_
                    if ti.static(with_embedding):
                        acc[tile, EMBEDDING], acc[tile, EMBEDDING + 1], acc[tile, EMBEDDING + 2] = ae0, ae1, ae2
                    if ti.static(with_curvature):
                        acc[tile, CURVATURE_COLOUR], acc[tile, CURVATURE_DEPTH] = ac, ad
                    acc[tile, ACC_H], acc[tile, ACC_X], acc[tile, ACC_Y] = m, mx, my
                    acc[tile, ACC_XX], acc[tile, ACC_XY], acc[tile, ACC_YY] = mxx, mxy, myy
                for c in ti.static((Z, ZU, ZV, RED, RED + 1, RED + 2)):
                    slot_grad[k, c] = acc[tile, c].sum()
                for c in ti.static(range(3)):
                    slot_grad[k, EMBEDDING + c] = 0.0
                    if ti.static(with_embedding):
                        slot_grad[k, EMBEDDING + c] = acc[tile, EMBEDDING + c].sum()
                for c in ti.static((CURVATURE_COLOUR, CURVATURE_DEPTH)):
                    slot_grad[k, c] = 0.0
                    if ti.static(with_curvature):
                        slot_grad[k, c] = acc[tile, c].sum()
                sx, sy, slope_sum = acc[tile, ACC_X].sum(), acc[tile, ACC_Y].sum(), acc[tile, ACC_SLOPE].sum()
                slot_grad[k, OPACITY] = acc[tile, ACC_H].sum() / op
                slot_grad[k, U] = 2.0 * qa * sx + qb * sy - zu * slope_sum
                slot_grad[k, V] = qb * sx + 2.0 * qc * sy - zv * slope_sum
                slot_grad[k, QA] = -acc[tile, ACC_XX].sum()
                slot_grad[k, QB] = -acc[tile, ACC_XY].sum()
                slot_grad[k, QC] = -acc[tile, ACC_YY].sum()


@ti.kernel
def gather_gradients(
    count: ti.i32,
    tile_count: nd(ti.i32, ndim=1),  # [N]
    first_of: nd(ti.i32, ndim=1),  # [N]
    slots_of: nd(ti.i32, ndim=1),  # [slots]
    slot_grad: nd(ti.f32, ndim=2),  # [slots, SPLAT_GRAD]
    splat_grad: nd(ti.f32, ndim=2),  # [N, SPLAT_GRAD] out
):
    """Sum each Gaussian's slots in a fixed order: no atomics, so the sum repeats."""
    for i in range(count):
        for c in ti.static(range(SPLAT_GRAD)):
            splat_grad[i, c] = 0.0
        for entry in range(first_of[i], first_of[i] + tile_count[i]):
            k = slots_of[entry]
            for c in ti.static(range(SPLAT_GRAD)):
                splat_grad[i, c] += slot_grad[k, c]
