"""Tile rasterizer for CUDA: a block a tile, a pixel a thread, and 8x4 pixels a warp.

Splats are sorted by depth first (stably, so that equal depths go by index); each is then listed once for every tile it
touches, and a stable sort of that list by tile leaves every tile's splats in depth order. For each (splat, tile) slot,
`find_reach` tells which of the tile's warps the splat reaches. A block fetches its slots in batches, and a warp walks
through the bits of its ballot over those that reach it: splats elsewhere in the tile cost it next to nothing.
"""

import taichi as ti

from tgslam.kernels.blending import least_exponent, raw_alpha, tangent_depth
from tgslam.kernels.cuda.block import BLOCK, WARPS
from tgslam.kernels.projection import EMBEDDING, FADE, INV_Z, M_EMBEDDING, QA, QB, QC, RED, SPLAT, ZU, ZV, U, V, Z
from tgslam.kernels.simd import ALPHA_MAX, ALPHA_MIN, REACH, T_MIN, TILE
from tgslam.kernels.warp import ALL, WARP, sums_of_4, sums_of_16

nd = ti.types.ndarray

DEPTH_BITS = 31  # of a positive float
NOWHERE = 0x7FFFFFFF  # depth key of a Gaussian that is not drawn: behind all others
PART_X, PART_Y = 8, 4  # px of a warp's part of a tile
PARTS_X = TILE // PART_X
FETCHED = 8  # values that a thread fetches at a time


@ti.kernel
def depth_keys(
    count: ti.i32,
    tile_count: nd(ti.i32, ndim=1),  # [N]
    splat: nd(ti.f32, ndim=2),  # [N, SPLAT]
    keys: nd(ti.i32, ndim=1),  # [count] out: positive floats order like their bits
    order: nd(ti.i32, ndim=1),  # [count] out: 0, 1, 2, ...
):
    """What the sort by depth begins with."""
    for i in range(count):
        order[i] = i
        keys[i] = NOWHERE
        if tile_count[i] > 0:
            keys[i] = ti.bit_cast(splat[i, Z], ti.i32)


@ti.func
def last_at_most(value, count, ascending: ti.template()):
    """Largest k < count with ascending[k] <= value; ascending[0] is."""
    low, high = 0, count
    while high - low > 1:
        middle = (low + high) >> 1
        if ascending[middle] <= value:
            low = middle
        else:
            high = middle
    return low


@ti.kernel
def list_slots(
    slots: ti.i32,
    count: ti.i32,
    order: nd(ti.i32, ndim=1),  # [count] Gaussians by depth
    first_of: nd(ti.i32, ndim=1),  # [count + 1] first slot of the k-th of them
    tile_rect: nd(ti.i32, ndim=2),  # [N, 4]
    tiles_x: ti.i32,
    tile: nd(ti.i32, ndim=1),  # [slots] out
    ids: nd(ti.i32, ndim=1),  # [slots] out: Gaussian
):
    """Every tile of every splat, in depth order; a thread a slot, so that large splats hold up nobody."""
    for slot in range(slots):
        k = last_at_most(slot, count, first_of)
        i, nth = order[k], slot - first_of[k]
        columns = tile_rect[i, 1] - tile_rect[i, 0] + 1
        row = nth // columns
        tile[slot] = (tile_rect[i, 2] + row) * tiles_x + tile_rect[i, 0] + nth - row * columns
        ids[slot] = i


@ti.kernel
def find_starts(
    slots: ti.i32,
    tiles: ti.i32,
    tile: nd(ti.i32, ndim=1),  # [slots] ascending
    start: nd(ti.i32, ndim=1),  # [tiles + 1] out: first slot of each tile
):
    """Where each tile's slots begin, tiles without any included."""
    for slot in range(slots + 1):
        before, here = -1, tiles
        if slot > 0:
            before = tile[slot - 1]
        if slot < slots:
            here = tile[slot]
        for t in range(before + 1, here + 1):
            start[t] = slot


@ti.func
def warps_reached(u, v, a, b, c, fade):
    """Bit w = the splat has alpha >= ALPHA_MIN somewhere in warp w's part of the tile; (u, v) relative to the tile."""
    reach = (REACH - fade) * 1.0001 + 1e-5  # rounding may not lose a pixel
    mask = 0
    for w in ti.static(range(WARPS)):
        x, y = (w % PARTS_X) * PART_X - u, w // PARTS_X * PART_Y - v
        if least_exponent(x, y, x + (PART_X - 1.0), y + (PART_Y - 1.0), a, b, c) <= reach:
            mask |= 1 << w
    return mask


@ti.kernel
def find_reach(
    slots: ti.i32,
    tiles_x: ti.i32,
    tile: nd(ti.i32, ndim=1),  # [slots]
    ids: nd(ti.i32, ndim=1),  # [slots]
    splat: nd(ti.f32, ndim=2),  # [N, SPLAT]
    reached: nd(ti.i32, ndim=1),  # [slots] out: bit w = the splat reaches warp w's part of the tile
):
    """Which warps have to look at a slot."""
    for slot in range(slots):
        i = ids[slot]
        u, v = splat[i, U] - tile[slot] % tiles_x * TILE, splat[i, V] - tile[slot] // tiles_x * TILE
        reached[slot] = warps_reached(u, v, splat[i, QA], splat[i, QB], splat[i, QC], splat[i, FADE])


@ti.func
def pixel_of(tile, tiles_x, warp, lane):
    """Column and row of a thread's pixel."""
    x = tile % tiles_x * TILE + warp % PARTS_X * PART_X + lane % PART_X
    y = tile // tiles_x * TILE + warp // PARTS_X * PART_Y + lane // PART_X
    return x, y


@ti.func
def fetch(first, end, thread, ids: ti.template(), splat: ti.template(), batch: ti.template()):
    """Copy the splat rows of slots [first, end), BLOCK at most, into the batch; returns the thread's own Gaussian.

    Each warp copies 32 rows, a row by 16 lanes, so that memory is read in long pieces. Values are read in groups
    before any is written: the compiler would wait for each one alone, since for all it knows the arrays overlap. And
    the lane's number goes through a shuffle, so that the compiler does not take it for the same in every batch; it
    would keep all addresses in registers (forward 72 instead of 64 at most, backward 86).
    """
    lane = ti.simt.warp.shfl_sync_i32(ti.u32(ALL), thread, thread) & (WARP - 1)
    upper = lane >> 4
    row, column = thread >> 5 << 5 | upper, lane & (SPLAT - 1)
    i = ids[ti.min(first + thread, end - 1)]
    for group in ti.static(range(0, WARP, 2 * FETCHED)):
        values = ti.Vector([0.0] * FETCHED)
        for k in ti.static(range(FETCHED)):
            source = ti.simt.warp.shfl_sync_i32(ti.u32(ALL), i, group + 2 * k + upper)
            values[k] = splat[source, column]
        for k in ti.static(range(FETCHED)):
            batch[row | group + 2 * k, column] = values[k]
    return i


@ti.func
def alpha_before_cap(dx, dy, j, batch: ti.template()):
    """The j-th splat's alpha at an offset from its centre, neither capped nor cut."""
    return raw_alpha(dx, dy, batch[j, QA], batch[j, QB], batch[j, QC], batch[j, FADE])


@ti.func
def lowest_bit(bits):
    """Position of the lowest bit that is set; there is one."""
    return 31 - ti.math.clz(bits & (-bits))


@ti.kernel
def forward(
    tiles: ti.i32,
    tiles_x: ti.i32,
    start: nd(ti.i32, ndim=1),  # [tiles + 1]
    ids: nd(ti.i32, ndim=1),  # [slots]
    reached: nd(ti.i32, ndim=1),  # [slots] of `find_reach`
    splat: nd(ti.f32, ndim=2),  # [N, SPLAT]
    with_embedding: ti.template(),
    stop: nd(ti.i32, ndim=2),  # [tiles, WARPS] out: slot behind the last one that a warp blended
    colour: nd(ti.f32, ndim=3),  # [H, W, 3] out
    depth: nd(ti.f32, ndim=2),  # [H, W] out, m, sum of weight times tangent-plane depth
    opacity: nd(ti.f32, ndim=2),  # [H, W] out
    embedding: nd(ti.f32, ndim=3),  # [H, W, 3] out
):
    """Alpha blending front to back; a warp ends when all of its pixels let less than T_MIN through."""
    ti.loop_config(block_dim=BLOCK)
    for i in range(tiles * BLOCK):
        batch = ti.simt.block.SharedArray((BLOCK, SPLAT), ti.f32)
        warps = ti.simt.block.SharedArray((BLOCK,), ti.i32)  # those that each splat of the batch reaches
        tile, thread = i // BLOCK, i % BLOCK
        warp, lane = thread // WARP, thread % WARP
        x, y = pixel_of(tile, tiles_x, warp, lane)
        px, py = ti.cast(x, ti.f32), ti.cast(y, ti.f32)
        inside = x < depth.shape[1] and y < depth.shape[0]
        T = ti.select(inside, 1.0, 0.0)
        r, g, b, d, e0, e1, e2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        first, end = start[tile], start[tile + 1]
        stopped_at = end
        is_open = 1
        any_open = ti.cast(first < end, ti.i32)
        while any_open != 0:
            fetch(first, end, thread, ids, splat, batch)
            warps[thread] = 0
            if first + thread < end:
                warps[thread] = reached[first + thread]
            ti.simt.block.sync()
            word = 0
            while word < BLOCK and is_open != 0:
                bits = ti.simt.warp.ballot((warps[word + lane] >> warp) & 1)
                while bits != 0:
                    j = (word + lowest_bit(bits)) & (BLOCK - 1)  # seen to be less than BLOCK: cheap addresses
                    bits &= bits - 1
                    dx, dy = px - batch[j, U], py - batch[j, V]
                    alpha = ti.min(alpha_before_cap(dx, dy, j, batch), ALPHA_MAX)
                    if alpha > ALPHA_MIN:
                        w = T * alpha
                        T -= w
                        r += w * batch[j, RED]
                        g += w * batch[j, RED + 1]
                        b += w * batch[j, RED + 2]
                        step = batch[j, ZU] * dx + batch[j, ZV] * dy
                        d += w * tangent_depth(step, batch[j, Z], batch[j, INV_Z])
                        if ti.static(with_embedding):
                            e0 += w * batch[j, EMBEDDING]
                            e1 += w * batch[j, EMBEDDING + 1]
                            e2 += w * batch[j, EMBEDDING + 2]
                    if ti.simt.warp.any_nonzero(ti.u32(ALL), ti.cast(T >= T_MIN, ti.i32)) == 0:
                        is_open, bits = 0, 0
                        stopped_at = first + j + 1
                word += WARP
            first += BLOCK
            any_open = ti.simt.block.sync_any_nonzero(is_open * ti.cast(first < end, ti.i32))
        if lane == 0:
            stop[tile, warp] = stopped_at
        if inside:
            colour[y, x, 0], colour[y, x, 1], colour[y, x, 2] = r, g, b
            depth[y, x], opacity[y, x] = d, 1.0 - T
            if ti.static(with_embedding):
                embedding[y, x, 0], embedding[y, x, 1], embedding[y, x, 2] = e0, e1, e2


@ti.kernel
def backward(
    tiles: ti.i32,
    tiles_x: ti.i32,
    start: nd(ti.i32, ndim=1),  # [tiles + 1]
    ids: nd(ti.i32, ndim=1),  # [slots]
    reached: nd(ti.i32, ndim=1),  # [slots] of `find_reach`
    splat: nd(ti.f32, ndim=2),  # [N, SPLAT]
    stop: nd(ti.i32, ndim=2),  # [tiles, WARPS] of `forward`
    with_embedding: ti.template(),
    with_curvature: ti.template(),
    colour: nd(ti.f32, ndim=3),  # [H, W, 3] of the forward pass
    depth: nd(ti.f32, ndim=2),  # [H, W]
    opacity: nd(ti.f32, ndim=2),  # [H, W]
    embedding: nd(ti.f32, ndim=3),  # [H, W, 3]
    g_colour: nd(ti.f32, ndim=3),  # [H, W, 3] dL/dcolour
    g_depth: nd(ti.f32, ndim=2),  # [H, W] dL/d(sum of weight times depth)
    g_opacity: nd(ti.f32, ndim=2),  # [H, W]
    g_embedding: nd(ti.f32, ndim=3),  # [H, W, 3]; read only with_embedding
    w_colour: nd(ti.f32, ndim=2),  # [H, W] second derivative of the loss in a colour channel; only with_curvature
    w_depth: nd(ti.f32, ndim=2),  # [H, W] second derivative of the loss in depth, 1/m^2; only with_curvature
    moments: nd(ti.f32, ndim=2),  # [N, MOMENTS] added to; lane k of a warp adds column k
):
    """Moments of every splat; nothing of the forward pass is stored but the image and where each warp stopped.

    dL/dalpha_i = T_i (g . c_i) - (g . out - sum_{k <= i} w_k g . c_k) / (1 - alpha_i), zero where alpha saturates.
    The warps add their sums in no fixed order, so that results repeat but for rounding.
    """
    ti.loop_config(block_dim=BLOCK)
    for i in range(tiles * BLOCK):
        batch = ti.simt.block.SharedArray((BLOCK, SPLAT), ti.f32)
        warps = ti.simt.block.SharedArray((BLOCK,), ti.i32)  # those that each splat of the batch reaches
        gaussian = ti.simt.block.SharedArray((BLOCK,), ti.i32)
        tile, thread = i // BLOCK, i % BLOCK
        warp, lane = thread // WARP, thread % WARP
        x, y = pixel_of(tile, tiles_x, warp, lane)
        px, py = ti.cast(x, ti.f32), ti.cast(y, ti.f32)
        T, rest = 0.0, 0.0  # transmittance, and g . out of what lies behind
        g0, g1, g2, gd, go, ge0, ge1, ge2, wc, wd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if x < depth.shape[1] and y < depth.shape[0]:
            T = 1.0
            g0, g1, g2 = g_colour[y, x, 0], g_colour[y, x, 1], g_colour[y, x, 2]
            gd, go = g_depth[y, x], g_opacity[y, x]
            rest = g0 * colour[y, x, 0] + g1 * colour[y, x, 1] + g2 * colour[y, x, 2]
            rest += gd * depth[y, x] + go * opacity[y, x]
            if ti.static(with_embedding):
                ge0, ge1, ge2 = g_embedding[y, x, 0], g_embedding[y, x, 1], g_embedding[y, x, 2]
                rest += ge0 * embedding[y, x, 0] + ge1 * embedding[y, x, 1] + ge2 * embedding[y, x, 2]
            if ti.static(with_curvature):
                wc, wd = w_colour[y, x], w_depth[y, x]
        first, end, stopped_at = start[tile], 0, stop[tile, warp]
        for w in ti.static(range(WARPS)):
            end = ti.max(end, stop[tile, w])
        while first < end:
            gaussian[thread] = fetch(first, end, thread, ids, splat, batch)
            warps[thread] = 0
            if first + thread < end:
                warps[thread] = reached[first + thread]
            ti.simt.block.sync()
            word = 0
            while word < BLOCK and first + word < stopped_at:
                wanted = (warps[word + lane] >> warp) & ti.cast(first + word + lane < stopped_at, ti.i32)
                bits = ti.simt.warp.ballot(wanted)
                while bits != 0:
                    j = (word + lowest_bit(bits)) & (BLOCK - 1)  # seen to be less than BLOCK: cheap addresses
                    bits &= bits - 1
                    dx, dy = px - batch[j, U], py - batch[j, V]
                    raw = alpha_before_cap(dx, dy, j, batch)
                    alpha = ti.min(raw, ALPHA_MAX)
                    touched = alpha > ALPHA_MIN
                    if ti.simt.warp.any_nonzero(ti.u32(ALL), ti.cast(touched, ti.i32)) != 0:
                        w, h, bend = 0.0, 0.0, 0.0
                        if touched:
                            w = T * alpha
                            step = batch[j, ZU] * dx + batch[j, ZV] * dy
                            bend = step * batch[j, INV_Z]
                            gc = g0 * batch[j, RED] + g1 * batch[j, RED + 1] + g2 * batch[j, RED + 2]
                            gc += gd * tangent_depth(step, batch[j, Z], batch[j, INV_Z]) + go
                            if ti.static(with_embedding):
                                gc += ge0 * batch[j, EMBEDDING] + ge1 * batch[j, EMBEDDING + 1]
                                gc += ge2 * batch[j, EMBEDDING + 2]
                            rest -= w * gc
                            if raw < ALPHA_MAX:
                                h = alpha * (T * gc - rest / (1.0 - alpha))
                            T -= w
                        wg = w * gd
                        ws = wg * (1.0 + 2.0 * bend)
                        hx, hy = h * dx, h * dy
                        total = sums_of_16(
                            h, hx, hy, hx * dx, hx * dy, hy * dy,
                            wg * (1.0 - bend * bend), ws * dx, ws * dy, ws,
                            w * g0, w * g1, w * g2, w * wc, w * wd, 0.0, lane,
                        )  # fmt: skip
                        columns = ti.static(15 if with_curvature else 13)
                        adds = lane < columns
                        if ti.static(with_embedding):
                            of_embedding = sums_of_4(w * ge0, w * ge1, w * ge2, 0.0, lane)
                            if lane >= M_EMBEDDING:
                                total = of_embedding
                                adds = lane < M_EMBEDDING + 3
                        if adds:
                            ti.atomic_add(moments[gaussian[j], lane], total)
                word += WARP
            first += BLOCK
            ti.simt.block.sync()  # the next batch, or the block's next tile, may overwrite this one now


@ti.kernel
def count_passes(
    slots: ti.i32,
    tile: nd(ti.i32, ndim=1),  # [slots]
    reached: nd(ti.i32, ndim=1),  # [slots]
    stop: nd(ti.i32, ndim=2),  # [tiles, WARPS] of `forward`
) -> ti.i32:
    """How many (splat, warp) pairs were blended: for benchmarks."""
    total = 0
    for slot in range(slots):
        for w in range(WARPS):
            if slot < stop[tile[slot], w]:
                total += (reached[slot] >> w) & 1
    return total
