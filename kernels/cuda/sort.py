"""Stable radix sort of 32-bit keys with a payload, 8 bits a pass, least significant first.

A pass cuts the array into chunks, a block each. `count_digits` counts the digits of every chunk, `scan_digits` adds
them up over the chunks, `scatter` moves each entry behind those with a lower digit, and behind those with its own digit
that come from an earlier chunk or stand before it in its own.
"""

import taichi as ti

from tgslam.kernels.cuda.block import BLOCK, WARPS, prefix_in_block
from tgslam.kernels.warp import ALL, WARP

nd = ti.types.ndarray

DIGIT_BITS = 8  # as many digits as a block has threads
DIGITS = 1 << DIGIT_BITS  # one for each thread of a block


@ti.func
def digit_of(key, shift):
    """The bits of a key that a pass sorts by; the key counts as unsigned."""
    return (key >> shift) & (DIGITS - 1)


@ti.func
def peers_of(digit):
    """Mask of the warp's lanes that have the same digit, 0 <= digit <= DIGITS (DIGITS itself: beyond the end)."""
    peers = -1
    for k in ti.static(range(DIGIT_BITS + 1)):
        is_set = (digit >> k) & 1
        lanes = ti.simt.warp.ballot(is_set)
        peers &= ti.select(is_set == 1, lanes, ~lanes)
    return peers


@ti.func
def count_by_warp(first, end, shift, thread, keys: ti.template(), counts: ti.template()):
    """counts[warp, digit] = how often a digit occurs in each warp's part of [first, end)."""
    warp, lane = thread // WARP, thread % WARP
    for k in ti.static(range(WARPS)):
        counts[k, thread] = 0
    ti.simt.block.sync()
    at = first + lane
    while at < end:
        ti.atomic_add(counts[warp, digit_of(keys[at], shift)], 1)
        at += WARP
    ti.simt.block.sync()


@ti.func
def warp_part(start, chunk, count, thread):
    """First entry and end of a warp's contiguous part of the chunk that begins at `start`."""
    first = start + thread // WARP * (chunk // WARPS)
    return first, ti.min(first + chunk // WARPS, count)


@ti.kernel
def count_digits(
    count: ti.i32,
    chunk: ti.i32,  # entries of a chunk, a multiple of BLOCK
    chunks: ti.i32,
    shift: ti.i32,
    keys: nd(ti.i32, ndim=1),  # [count]
    digit_counts: nd(ti.i32, ndim=2),  # [DIGITS, CHUNKS] out
):
    """How often each digit occurs in each chunk."""
    ti.loop_config(block_dim=BLOCK)
    for i in range(chunks * BLOCK):
        counts = ti.simt.block.SharedArray((WARPS, DIGITS), ti.i32)
        thread = i % BLOCK
        first, end = warp_part(i // BLOCK * chunk, chunk, count, thread)
        count_by_warp(first, end, shift, thread, keys, counts)
        total = 0
        for k in ti.static(range(WARPS)):
            total += counts[k, thread]
        digit_counts[thread, i // BLOCK] = total
        ti.simt.block.sync()  # this block's next chunk may clear the counts now


@ti.kernel
def scan_digits(
    chunks: ti.i32,
    digit_counts: nd(ti.i32, ndim=2),  # [DIGITS, CHUNKS] of `count_digits`; out: sums over the earlier chunks
    totals: nd(ti.i32, ndim=1),  # [DIGITS] out: sums over all chunks
):
    """Where each chunk's entries begin among those of the same digit."""
    ti.loop_config(block_dim=BLOCK)
    for i in range(DIGITS * BLOCK):
        digit, thread = i // BLOCK, i % BLOCK
        own = 0
        if thread < chunks:
            own = digit_counts[digit, thread]
        before, total = prefix_in_block(own, thread)
        if thread < chunks:
            digit_counts[digit, thread] = before
        if thread == 0:
            totals[digit] = total


@ti.kernel
def scatter(
    count: ti.i32,
    chunk: ti.i32,  # entries of a chunk, a multiple of BLOCK
    chunks: ti.i32,
    shift: ti.i32,
    keys: nd(ti.i32, ndim=1),  # [count]
    values: nd(ti.i32, ndim=1),  # [count]
    digit_before: nd(ti.i32, ndim=2),  # [DIGITS, CHUNKS] of `scan_digits`
    totals: nd(ti.i32, ndim=1),  # [DIGITS] of `scan_digits`
    sorted_keys: nd(ti.i32, ndim=1),  # [count] out
    sorted_values: nd(ti.i32, ndim=1),  # [count] out
):
    """Move every entry to its place by the digit; entries with the same digit keep their order."""
    ti.loop_config(block_dim=BLOCK)
    for i in range(chunks * BLOCK):
        cursor = ti.simt.block.SharedArray((WARPS, DIGITS), ti.i32)  # place of the next entry of a warp with a digit
        thread = i % BLOCK
        warp, lane = thread // WARP, thread % WARP
        first, end = warp_part(i // BLOCK * chunk, chunk, count, thread)
        count_by_warp(first, end, shift, thread, keys, cursor)
        lower_digits, _ = prefix_in_block(totals[thread], thread)
        place = lower_digits + digit_before[thread, i // BLOCK]
        for k in ti.static(range(WARPS)):
            in_warp = cursor[k, thread]
            cursor[k, thread] = place
            place += in_warp
        ti.simt.block.sync()
        start = first
        while start < end:
            at = start + lane
            digit = DIGITS
            if at < end:
                digit = digit_of(keys[at], shift)
            peers = peers_of(digit)
            rank = ti.math.popcnt(peers & ((1 << lane) - 1))
            to = 0
            if at < end:
                to = cursor[warp, digit] + rank
                sorted_keys[to] = keys[at]
                sorted_values[to] = values[at]
            ti.simt.warp.sync(ti.u32(ALL))
            if at < end and rank == 0:
                cursor[warp, digit] = to + ti.math.popcnt(peers)
            ti.simt.warp.sync(ti.u32(ALL))
            start += WARP
        ti.simt.block.sync()  # this block's next chunk may clear the counts now
