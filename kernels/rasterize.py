"""Tile lists, forward and backward rasterization on the CPU, 16 pixels at a time.

A tile's 16x16 pixels are 16 chunks of 4x4; the 16 lanes are a chunk's pixels. A slot is a splat in a tile, in depth
order. `pack_tile` copies a slot's row next to its neighbours in depth and finds the chunks that its alpha >= 1/255
ellipse touches. They are noted twice: as a mask of 16 bits a slot, and for each chunk as a number whose bits are the
slots of a group that reach it. The forward pass goes chunk by chunk over the bits of those numbers, the backward pass
splat by splat over those of its mask, with the lane sums of all accumulators taken in one transposition. Every output
has one writer, so results repeat bit for bit.
"""

import taichi as ti

from tgslam.kernels.blending import least_exponent, raw_alpha, tangent_depth
from tgslam.kernels.projection import EMBEDDING, FADE, INV_Z, QA, QB, QC, RED, ZU, ZV, U, V, Z
from tgslam.kernels.simd import (
    ALPHA_MAX,
    ALPHA_MIN,
    CHUNK,
    CHUNKS,
    LANE_X,
    LANE_Y,
    LANES,
    PER_ROW,
    REACH,
    SPREAD,
    T_MIN,
    TILE,
    Lanes,
    at_most,
    lane_max,
    lane_sum,
    lanes_kernel,
    sums_of_4,
    sums_of_16,
)

nd = ti.types.ndarray

# Rows of the pixel gradient per chunk
G_COLOUR, G_DEPTH, G_OPACITY, W_COLOUR, W_DEPTH, G_EMBEDDING = 0, 3, 4, 7, 8, 9
G_T, G_REST = 5, 6  # and what changes from splat to splat: transmittance, g . out of what lies behind
G = 12
GROUP = 23  # slots whose hits of a chunk make one number, which a float holds exactly
SEGMENTS = 16  # parts of the depth order that are counted and scattered on their own
_THREAD_STEP = 512  # iterations that Taichi hands a thread at a time


@ti.kernel
def count_slots(
    visible: ti.i32,
    order: nd(ti.i32, ndim=1),  # [visible] Gaussian indices by depth, ties by index
    tile_rect: nd(ti.i32, ndim=2),  # [N, 4]
    first_of: nd(ti.i32, ndim=1),  # [N] first entry of a Gaussian
    tiles_x: ti.i32,
    by_depth: nd(ti.i32, ndim=2),  # [visible or more, 4] out: first tile, columns of tiles, tiles, first entry
    per_tile: nd(ti.i32, ndim=2),  # [SEGMENTS, tiles + tiles_x + 1] out, the last tiles_x + 1 without meaning
):
    """How many splats of each segment of the order touch each tile; a row each, for threads share no cache line then.

    A rectangle of tiles is four entries of a table whose running sums, down and then along the tiles, count them: no
    branch depends on what memory out of order has yet to bring.
    """
    for spread in range(SEGMENTS * _THREAD_STEP):
        segment = spread // _THREAD_STEP
        if spread - segment * _THREAD_STEP == 0:
            for tile in range(per_tile.shape[1]):
                per_tile[segment, tile] = 0
            for o in range(segment * visible // SEGMENTS, (segment + 1) * visible // SEGMENTS):
                i = order[o]
                columns, rows = tile_rect[i, 1] - tile_rect[i, 0] + 1, tile_rect[i, 3] - tile_rect[i, 2] + 1
                tile = tile_rect[i, 2] * tiles_x + tile_rect[i, 0]
                by_depth[o, 0], by_depth[o, 1], by_depth[o, 2] = tile, columns, columns * rows
                by_depth[o, 3] = first_of[i]
                below = tile + rows * tiles_x
                per_tile[segment, tile] = per_tile[segment, tile] + 1  # `+=` would be atomic, and slow
                per_tile[segment, tile + columns] = per_tile[segment, tile + columns] - 1
                per_tile[segment, below] = per_tile[segment, below] - 1
                per_tile[segment, below + columns] = per_tile[segment, below + columns] + 1
            for tile in range(tiles_x, per_tile.shape[1]):
                per_tile[segment, tile] = per_tile[segment, tile] + per_tile[segment, tile - tiles_x]
            for tile in range(1, per_tile.shape[1]):
                per_tile[segment, tile] = per_tile[segment, tile] + per_tile[segment, tile - 1]


@ti.kernel
def fill_slots(
    visible: ti.i32,
    order: nd(ti.i32, ndim=1),  # [visible] Gaussian indices by depth, ties by index
    by_depth: nd(ti.i32, ndim=2),  # [visible, 4] of `count_slots`
    tiles_x: ti.i32,
    cursor: nd(ti.i32, ndim=2),  # [SEGMENTS, tiles] first slot of each tile and segment; advanced
    ids: nd(ti.i32, ndim=1),  # [slots] out: the Gaussian of each slot
    entry: nd(ti.i32, ndim=1),  # [slots] out: where the slot's gradient goes, so that a Gaussian's lie together
):
    """Scatter in depth order: the lists come out sorted with no sort per tile."""
    for spread in range(SEGMENTS * _THREAD_STEP):
        segment = spread // _THREAD_STEP
        if spread - segment * _THREAD_STEP == 0:
            for o in range(segment * visible // SEGMENTS, (segment + 1) * visible // SEGMENTS):
                i = order[o]
                tile, columns, to = by_depth[o, 0], by_depth[o, 1], by_depth[o, 3]
                left = columns
                for k in range(to, to + by_depth[o, 2]):
                    slot = cursor[segment, tile]
                    cursor[segment, tile] = slot + 1
                    ids[slot], entry[slot] = i, k
                    left -= 1
                    tile += ti.select(left == 0, tiles_x - columns + 1, 1)
                    left = ti.select(left == 0, columns, left)


@ti.func
def groups_of(tile, start: ti.template()):
    """How many groups the slots of a tile make."""
    return (start[tile + 1] - start[tile] + GROUP - 1) // GROUP


@ti.func
def group_row(tile, start: ti.template()):
    """Row of a tile's first group in an array of slots / GROUP + tiles rows."""
    return start[tile] // GROUP + tile


@ti.func
def pack_tile(
    tile,
    tiles_x,
    start: ti.template(),
    ids: ti.template(),
    splat: ti.template(),
    rows: ti.template(),
    mask: ti.template(),
    groups: ti.template(),
):
    """Copy a tile's splat rows into slot order and find the chunks each reaches; the lanes are the 16 chunks.

    The arrays are those of `forward`.
    """
    x0, y0 = ti.cast((tile % tiles_x) * TILE, ti.f32), ti.cast((tile // tiles_x) * TILE, ti.f32)
    chunk_x, chunk_y = float(CHUNK) * Lanes(LANE_X), float(CHUNK) * Lanes(LANE_Y)
    powers = Lanes([float(1 << c) for c in range(CHUNKS)])
    for group in range(groups_of(tile, start)):
        first = start[tile] + group * GROUP
        hits, power = Lanes(0.0), 1.0
        for k in range(first, ti.min(first + GROUP, start[tile + 1])):
            row = splat[ids[k]]
            u, v = row[U] - x0, row[V] - y0
            row[U], row[V] = u, v
            rows[k] = row
            reach = (REACH - row[FADE]) * 1.0001 + 1e-5  # rounding may not lose a pixel
            x, y = chunk_x - u, chunk_y - v
            q = least_exponent(x, y, x + (CHUNK - 1.0), y + (CHUNK - 1.0), row[QA], row[QB], row[QC])
            reached = q <= Lanes(reach)
            mask[k] = ti.cast(lane_sum(ti.select(reached, powers, Lanes(0.0))), ti.i32)
            hits += ti.select(reached, Lanes(power), Lanes(0.0))
            power *= 2.0
        groups[group_row(tile, start) + group] = hits


@lanes_kernel
def forward(
    tiles: ti.i32,
    tiles_x: ti.i32,
    start: nd(ti.i32, ndim=1),  # [tiles + 1]
    ids: nd(ti.i32, ndim=1),  # [slots]
    splat: nd(Lanes, ndim=1),  # [N] rows
    rows: nd(Lanes, ndim=1),  # [slots] out: the splats' rows, u and v relative to the tile
    slot: nd(ti.f32, ndim=2),  # [slots, SPLAT] the same memory as rows
    mask: nd(ti.i32, ndim=1),  # [slots] out: bit c = the splat reaches chunk c, and no opaque splats hide it there
    groups: nd(Lanes, ndim=1),  # [slots / GROUP + tiles] scratch: a group's slots that reach chunk c, as bits of lane c
    hits: nd(ti.f32, ndim=2),  # [slots / GROUP + tiles, CHUNKS] the same memory
    pixels: nd(Lanes, ndim=2),  # [CHUNKS, 2] x and y of a chunk's pixels in its tile
    with_embedding: ti.template(),
    colour: nd(ti.f32, ndim=3),  # [H, W, 3] out
    depth: nd(ti.f32, ndim=2),  # [H, W] out, m, sum of weight times tangent-plane depth
    opacity: nd(ti.f32, ndim=2),  # [H, W] out
    embedding: nd(ti.f32, ndim=3),  # [H, W, 3] out
):
    """Alpha blending front to back."""
    for spread in range(tiles * SPREAD):
        tile = spread // SPREAD
        if spread - tile * SPREAD == 0:
            pack_tile(tile, tiles_x, start, ids, splat, rows, mask, groups)
            for chunk in range(CHUNKS):
                px, py = pixels[chunk, 0], pixels[chunk, 1]
                T, r, g, b, d = Lanes(1.0), Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0)
                e0, e1, e2 = Lanes(0.0), Lanes(0.0), Lanes(0.0)
                m, end = 0, start[tile + 1]
                for group in range(groups_of(tile, start)):
                    base = start[tile] + group * GROUP
                    bits = ti.select(base < end, ti.cast(hits[group_row(tile, start) + group, chunk], ti.i32), 0)
                    while bits != 0:
                        lowest = bits & (-bits)
                        bits ^= lowest
                        k = base + 31 - ti.math.clz(lowest)
                        dx, dy = px - slot[k, U], py - slot[k, V]
                        raw = raw_alpha(dx, dy, slot[k, QA], slot[k, QB], slot[k, QC], slot[k, FADE])
                        w = T * ti.select(raw > Lanes(ALPHA_MIN), at_most(raw, ALPHA_MAX), Lanes(0.0))
                        r += w * slot[k, RED]
                        g += w * slot[k, RED + 1]
                        b += w * slot[k, RED + 2]
                        d += w * tangent_depth(slot[k, ZU] * dx + slot[k, ZV] * dy, slot[k, Z], slot[k, INV_Z])
                        if ti.static(with_embedding):
                            e0 += w * slot[k, EMBEDDING]
                            e1 += w * slot[k, EMBEDDING + 1]
                            e2 += w * slot[k, EMBEDDING + 2]
                        T = T - w
                        m += 1
                        if (m & 7) == 0:
                            if lane_max(T) < T_MIN:
                                bits = 0
                                end = k + 1
                for k in range(end, start[tile + 1]):
                    mask[k] = mask[k] & ~(1 << chunk)
                x0 = (tile % tiles_x) * TILE + (chunk % PER_ROW) * CHUNK
                y0 = (tile // tiles_x) * TILE + (chunk // PER_ROW) * CHUNK
                for j in ti.static(range(LANES)):
                    x, y = x0 + j % CHUNK, y0 + j // CHUNK
                    if x < depth.shape[1] and y < depth.shape[0]:
                        colour[y, x, 0], colour[y, x, 1], colour[y, x, 2] = r[j], g[j], b[j]
                        depth[y, x], opacity[y, x] = d[j], 1.0 - T[j]
                        if ti.static(with_embedding):
                            embedding[y, x, 0], embedding[y, x, 1], embedding[y, x, 2] = e0[j], e1[j], e2[j]


@ti.func
def chunk_of(image: ti.template(), x0, y0):
    """The pixels of a chunk of an [H, W] image; the image's last column and row go on beyond it."""
    rows = [ti.min(y0 + i, image.shape[0] - 1) for i in range(CHUNK)]
    columns = [ti.min(x0 + i, image.shape[1] - 1) for i in range(CHUNK)]
    return Lanes([image[y, x] for y in rows for x in columns])


@ti.func
def chunk_of_channel(image: ti.template(), x0, y0, channel: ti.template()):
    """The same of one channel of an [H, W, 3] image."""
    rows = [ti.min(y0 + i, image.shape[0] - 1) for i in range(CHUNK)]
    columns = [ti.min(x0 + i, image.shape[1] - 1) for i in range(CHUNK)]
    return Lanes([image[y, x, channel] for y in rows for x in columns])


@ti.func
def spread_gradient(
    tile,
    tiles_x,
    with_embedding: ti.template(),
    with_curvature: ti.template(),
    colour: ti.template(),
    depth: ti.template(),
    opacity: ti.template(),
    embedding: ti.template(),
    g_colour: ti.template(),
    g_depth: ti.template(),
    g_opacity: ti.template(),
    g_embedding: ti.template(),
    w_colour: ti.template(),
    w_depth: ti.template(),
    pixels: ti.template(),
    g: ti.template(),
):
    """A tile's image gradients -> chunk layout, with g . out per pixel; pixels beyond the image get zero."""
    tile_x, tile_y = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
    columns, rows = ti.cast(depth.shape[1] - tile_x, ti.f32), ti.cast(depth.shape[0] - tile_y, ti.f32)
    for chunk in range(CHUNKS):
        row = tile * CHUNKS + chunk
        x0, y0 = tile_x + (chunk % PER_ROW) * CHUNK, tile_y + (chunk // PER_ROW) * CHUNK
        inside = ti.select(pixels[chunk, 0] < Lanes(columns), Lanes(1.0), Lanes(0.0))
        inside *= ti.select(pixels[chunk, 1] < Lanes(rows), Lanes(1.0), Lanes(0.0))
        gd, go = chunk_of(g_depth, x0, y0) * inside, chunk_of(g_opacity, x0, y0) * inside
        g[row, G_DEPTH], g[row, G_OPACITY] = gd, go
        total = gd * chunk_of(depth, x0, y0) + go * chunk_of(opacity, x0, y0)
        for c in ti.static(range(3)):
            gc = chunk_of_channel(g_colour, x0, y0, c) * inside
            g[row, G_COLOUR + c] = gc
            total += gc * chunk_of_channel(colour, x0, y0, c)
            if ti.static(with_embedding):
                ge = chunk_of_channel(g_embedding, x0, y0, c) * inside
                g[row, G_EMBEDDING + c] = ge
                total += ge * chunk_of_channel(embedding, x0, y0, c)
        if ti.static(with_curvature):
            g[row, W_COLOUR] = chunk_of(w_colour, x0, y0) * inside
            g[row, W_DEPTH] = chunk_of(w_depth, x0, y0) * inside
        g[row, G_REST] = total
        g[row, G_T] = Lanes(1.0)


@lanes_kernel
def backward(
    tiles: ti.i32,
    tiles_x: ti.i32,
    start: nd(ti.i32, ndim=1),  # [tiles + 1]
    slot: nd(ti.f32, ndim=2),  # [slots, SPLAT]
    mask: nd(ti.i32, ndim=1),  # [slots] as the forward pass left it
    entry: nd(ti.i32, ndim=1),  # [slots] row of slot_grad that each slot writes
    with_embedding: ti.template(),
    with_curvature: ti.template(),
    colour: nd(ti.f32, ndim=3),  # [H, W, 3] of the forward pass
    depth: nd(ti.f32, ndim=2),  # [H, W]
    opacity: nd(ti.f32, ndim=2),  # [H, W]
    embedding: nd(ti.f32, ndim=3),  # [H, W, 3]
    g_colour: nd(ti.f32, ndim=3),  # [H, W, 3] dL/dcolour
    g_depth: nd(ti.f32, ndim=2),  # [H, W] dL/d(sum of weight times depth)
    g_opacity: nd(ti.f32, ndim=2),  # [H, W]
    g_embedding: nd(ti.f32, ndim=3),  # [H, W, 3]
    w_colour: nd(ti.f32, ndim=2),  # [H, W] second derivative of the loss in a colour channel
    w_depth: nd(ti.f32, ndim=2),  # [H, W] second derivative of the loss in depth, 1/m^2
    pixels: nd(Lanes, ndim=2),  # [CHUNKS, 2] x and y of a chunk's pixels in its tile: read, not computed, for latency
    g: nd(Lanes, ndim=2),  # [tiles * CHUNKS, G] scratch
    slot_grad: nd(Lanes, ndim=1),  # [slots] out: moments
    slot_embedding_grad: nd(Lanes, ndim=1),  # [slots] out: the embedding's, written only with one
):
    """Moments of every slot, splat by splat over its chunks; nothing of the forward pass is stored but the image.

    dL/dalpha_i = T_i (g . c_i) - (g . out - sum_{k <= i} w_k g . c_k) / (1 - alpha_i), zero where alpha saturates.
    """
    for spread in range(tiles * SPREAD):
        tile = spread // SPREAD
        if spread - tile * SPREAD == 0:
            spread_gradient(
                tile, tiles_x, with_embedding, with_curvature, colour, depth, opacity, embedding,
                g_colour, g_depth, g_opacity, g_embedding, w_colour, w_depth, pixels, g,
            )  # fmt: skip
            for k in range(start[tile], start[tile + 1]):
                u, v, z, inv_z = slot[k, U], slot[k, V], slot[k, Z], slot[k, INV_Z]
                a0, a1, a2, az, azu, azv = Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0)
                ae0, ae1, ae2, slope = Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0)
                m, mx, my, mxx, mxy, myy = Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0), Lanes(0.0)
                ac, ad = Lanes(0.0), Lanes(0.0)
                bits = mask[k]
                while bits != 0:
                    lowest = bits & (-bits)
                    bits ^= lowest
                    chunk = 31 - ti.math.clz(lowest)
                    row = tile * CHUNKS + chunk
                    dx, dy = pixels[chunk, 0] - u, pixels[chunk, 1] - v
                    T, rest = g[row, G_T], g[row, G_REST]
                    gd = g[row, G_DEPTH]
                    raw = raw_alpha(dx, dy, slot[k, QA], slot[k, QB], slot[k, QC], slot[k, FADE])
                    alpha = ti.select(raw > Lanes(ALPHA_MIN), at_most(raw, ALPHA_MAX), Lanes(0.0))
                    w = T * alpha
                    step = slot[k, ZU] * dx + slot[k, ZV] * dy
                    gc = g[row, 0] * slot[k, RED] + g[row, 1] * slot[k, RED + 1] + g[row, 2] * slot[k, RED + 2]
                    gc += gd * tangent_depth(step, z, inv_z) + g[row, G_OPACITY]
                    if ti.static(with_embedding):
                        ge0, ge1, ge2 = g[row, G_EMBEDDING], g[row, G_EMBEDDING + 1], g[row, G_EMBEDDING + 2]
                        gc += ge0 * slot[k, EMBEDDING] + ge1 * slot[k, EMBEDDING + 1] + ge2 * slot[k, EMBEDDING + 2]
                        ae0 += w * ge0
                        ae1 += w * ge1
                        ae2 += w * ge2
                    rest = rest - w * gc
                    h = T * gc - rest / (1.0 - alpha)
                    h *= ti.select(raw < Lanes(ALPHA_MAX), alpha, Lanes(0.0))
                    g[row, G_T], g[row, G_REST] = T - w, rest
                    a0 += w * g[row, 0]
                    a1 += w * g[row, 1]
                    a2 += w * g[row, 2]
                    wg = w * gd
                    bend = step * inv_z
                    az += wg * (1.0 - bend * bend)
                    ws = wg * (1.0 + 2.0 * bend)
                    slope += ws
                    azu += ws * dx
                    azv += ws * dy
                    if ti.static(with_curvature):
                        ac += w * g[row, W_COLOUR]
                        ad += w * g[row, W_DEPTH]
                    hx, hy = h * dx, h * dy
                    m += h
                    mx += hx
                    my += hy
                    mxx += hx * dx
                    mxy += hx * dy
                    myy += hy * dy
                to = entry[k]
                slot_grad[to] = sums_of_16(
                    m, mx, my, mxx, mxy, myy, az, azu, azv, slope, a0, a1, a2, ac, ad, Lanes(0.0)
                )
                if ti.static(with_embedding):
                    slot_embedding_grad[to] = sums_of_4(ae0, ae1, ae2, Lanes(0.0))


@lanes_kernel
def gather_gradients(
    count: ti.i32,
    tile_count: nd(ti.i32, ndim=1),  # [N]
    first_of: nd(ti.i32, ndim=1),  # [N]
    with_embedding: ti.template(),
    slot_grad: nd(Lanes, ndim=1),  # [slots]
    slot_embedding_grad: nd(Lanes, ndim=1),  # [slots]
    splat_grad: nd(Lanes, ndim=2),  # [N, 2] out
):
    """Sum each Gaussian's slots in a fixed order: no atomics, so the sum repeats."""
    for i in range(count):
        total, embedding = Lanes(0.0), Lanes(0.0)
        for k in range(first_of[i], first_of[i] + tile_count[i]):
            total += slot_grad[k]
            if ti.static(with_embedding):
                embedding += slot_embedding_grad[k]
        splat_grad[i, 0] = total
        if ti.static(with_embedding):
            splat_grad[i, 1] = embedding
