"""Procedural surface colours, band-limited by the pixel's footprint. Coordinates (s, t) are metres on the surface."""

import taichi as ti

PLAIN, CLOUD, TILES, PLANKS, BOOKS, PICTURE, WEAVE = range(7)  # material kinds

_OCTAVES = 4  # of noise, each twice as fine and half as strong as the one before
_STEP_I, _STEP_J = 1640531513, 1013904223  # what a lattice step adds to the word that is hashed
_JOINT = 0.035  # share of a tile or plank that is joint
_PICTURE_BORDER_M = 0.035  # the mount round a picture


@ti.func
def _lattice_word(i: ti.i32, j: ti.i32, seed: ti.i32) -> ti.u32:
    return (
        ti.cast(i, ti.u32) * ti.cast(_STEP_I, ti.u32)
        + ti.cast(j, ti.u32) * ti.cast(_STEP_J, ti.u32)
        + ti.cast(seed, ti.u32) * ti.cast(1597334677, ti.u32)
    )


@ti.func
def _mixed(word: ti.u32) -> ti.f32:
    """A number in [0, 1) that looks random, from a word that does not."""
    h = word
    h = (h ^ (h >> ti.cast(16, ti.u32))) * ti.cast(2057459429, ti.u32)
    h = (h ^ (h >> ti.cast(13, ti.u32))) * ti.cast(1274126177, ti.u32)
    h = h ^ (h >> ti.cast(16, ti.u32))
    return ti.cast(h >> ti.cast(8, ti.u32), ti.f32) * (1.0 / 16777216.0)


@ti.func
def lattice_hash(i: ti.i32, j: ti.i32, seed: ti.i32) -> ti.f32:
    """A number in [0, 1) for an integer lattice point."""
    return _mixed(_lattice_word(i, j, seed))


@ti.func
def _clamp01(x: ti.f32) -> ti.f32:
    return ti.min(ti.max(x, 0.0), 1.0)


@ti.func
def _corners(i: ti.i32, j: ti.i32, ws: ti.f32, wt: ti.f32, seed: ti.i32) -> ti.f32:
    word = _lattice_word(i, j, seed)
    step_i = ti.cast(_STEP_I, ti.u32)
    above = word + ti.cast(_STEP_J, ti.u32)
    low = _mixed(word) * (1.0 - ws) + _mixed(word + step_i) * ws
    high = _mixed(above) * (1.0 - ws) + _mixed(above + step_i) * ws
    return low * (1.0 - wt) + high * wt


@ti.func
def _octaves(s: ti.f32, t: ti.f32, width: ti.f32, seed: ti.i32) -> ti.f32:
    """Fractal value noise about 0, within (-1, 1); s, t and the footprint `width` in cells of the coarsest octave."""
    total = 0.0
    frequency = 1.0
    amplitude = 1.0
    for octave in range(_OCTAVES):
        fade = _clamp01(2.0 - 2.0 * width * frequency)
        if fade > 0.0:
            x = s * frequency
            y = t * frequency
            i = ti.floor(x)
            j = ti.floor(y)
            fx = x - i
            fy = y - j
            wx = fx * fx * (3.0 - 2.0 * fx)
            wy = fy * fy * (3.0 - 2.0 * fy)
            noise = _corners(ti.cast(i, ti.i32), ti.cast(j, ti.i32), wx, wy, seed + octave)
            total += amplitude * fade * (noise - 0.5)
        frequency *= 2.0
        amplitude *= 0.55
    return total


@ti.func
def _cells(s: ti.f32, t: ti.f32, ws: ti.f32, wt: ti.f32, seed: ti.i32) -> ti.f32:
    """A constant in [0, 1) for each unit cell, blended over the footprint (ws, wt) at borders, 0.5 when far away."""
    x = s - 0.5
    y = t - 0.5
    i = ti.floor(x)
    j = ti.floor(y)
    bx = _clamp01((x - i - 0.5) / ti.min(ti.max(ws, 1e-3), 1.0) + 0.5)
    by = _clamp01((y - j - 0.5) / ti.min(ti.max(wt, 1e-3), 1.0) + 0.5)
    fade = _clamp01(2.0 - ti.max(ws, wt))
    return 0.5 + fade * (_corners(ti.cast(i, ti.i32), ti.cast(j, ti.i32), bx, by, seed) - 0.5)


@ti.func
def _cells_along(s: ti.f32, ws: ti.f32, seed: ti.i32) -> ti.f32:
    """`_cells` in one dimension."""
    x = s - 0.5
    i = ti.floor(x)
    blend = _clamp01((x - i - 0.5) / ti.min(ti.max(ws, 1e-3), 1.0) + 0.5)
    left = lattice_hash(ti.cast(i, ti.i32), 0, seed)
    right = lattice_hash(ti.cast(i, ti.i32) + 1, 0, seed)
    return 0.5 + _clamp01(2.0 - ws) * (left * (1.0 - blend) + right * blend - 0.5)


@ti.func
def _pulse_integral(x: ti.f32, duty: ti.f32) -> ti.f32:
    whole = ti.floor(x)
    return whole * duty + ti.min(x - whole, duty)


@ti.func
def _pulse(x: ti.f32, width: ti.f32, duty: ti.f32) -> ti.f32:
    """Share of [x - width/2, x + width/2] whose fractional part is below `duty`: a box-filtered pulse train."""
    w = ti.max(width, 4e-3)
    return (_pulse_integral(x + 0.5 * w, duty) - _pulse_integral(x - 0.5 * w, duty)) / w


@ti.func
def _plank_row(row: ti.i32, s: ti.f32, ws: ti.f32, seed: ti.i32) -> ti.math.vec2:
    """(tint in [0, 1), joint coverage) of one row of planks; s and ws in plank lengths."""
    x = s + lattice_hash(row, 17, seed)
    tint = _cells_along(x, ws, seed + 31 * row)
    return ti.math.vec2(tint, _pulse(x + 0.5 * _JOINT, ws, 0.3 * _JOINT))


@ti.func
def _planks(s: ti.f32, t: ti.f32, ws: ti.f32, wt: ti.f32, seed: ti.i32) -> ti.math.vec2:
    """(tint, joint coverage) of planks along s, rows staggered; lengths in planks."""
    y = t - 0.5
    j = ti.floor(y)
    blend = _clamp01((y - j - 0.5) / ti.min(ti.max(wt, 1e-3), 1.0) + 0.5)
    row = ti.cast(j, ti.i32)
    tint_joint = _plank_row(row, s, ws, seed) * (1.0 - blend) + _plank_row(row + 1, s, ws, seed) * blend
    across = _pulse(t + 0.5 * _JOINT, wt, _JOINT)
    tint_joint[1] = 1.0 - (1.0 - tint_joint[1]) * (1.0 - across)
    return tint_joint


@ti.func
def _books(
    s: ti.f32, t01: ti.f32, ws: ti.f32, wt: ti.f32, seed: ti.i32, a: ti.math.vec3, b: ti.math.vec3
) -> ti.math.vec3:
    """Book spines; s in book widths, t01 in [0, 1] from the shelf's bottom to its top."""
    colour = ti.math.vec3(0.0)
    for channel in ti.static(range(3)):
        tint = _cells_along(s, ws, seed + channel)
        colour[channel] = (a[channel] * (1.0 - tint) + b[channel] * tint) * (0.55 + 0.9 * tint)
    top = 0.72 + 0.25 * _cells_along(s, ws, seed + 7)
    band_at = 0.35 + 0.25 * _cells_along(s, ws, seed + 11)
    soft = ti.max(wt, 0.01)
    band = _clamp01(0.5 + (0.06 - ti.abs(t01 - band_at)) / soft)
    colour = colour * (1.0 - 0.6 * band) + ti.math.vec3(0.85, 0.8, 0.6) * (0.6 * band)
    gap = _pulse(s + 0.04, ws, 0.08)
    above = _clamp01(0.5 + (t01 - top) / soft)
    dark = 1.0 - (1.0 - 0.7 * gap) * (1.0 - 0.85 * above)
    return colour * (1.0 - dark)


@ti.func
def _picture(
    s: ti.f32, t: ti.f32, w: ti.f32, scale: ti.f32, seed: ti.i32, a: ti.math.vec3, contrast: ti.f32
) -> ti.math.vec3:
    """An abstract picture: blocks and clouds, each channel its own."""
    colour = ti.math.vec3(0.0)
    for channel in ti.static(range(3)):
        blocks = _cells(s / scale, t / (0.7 * scale), w / scale, w / (0.7 * scale), seed + channel) - 0.5
        clouds = _octaves(s / (2.0 * scale), t / (2.0 * scale), w / (2.0 * scale), seed + 40 + channel)
        colour[channel] = a[channel] + contrast * (0.6 * blocks + 0.6 * clouds)
    return colour


@ti.func
def surface_colour(
    kind: ti.i32,
    seed: ti.i32,
    a: ti.math.vec3,
    b: ti.math.vec3,
    scale_s: ti.f32,
    scale_t: ti.f32,
    contrast: ti.f32,
    st: ti.math.vec2,
    half: ti.math.vec2,
    width: ti.math.vec2,
) -> ti.math.vec3:
    """Albedo [3] at (s, t) m of a surface of half sizes `half` m, averaged over about the footprint `width` m."""
    s = st[0] / scale_s
    t = st[1] / scale_t
    ws = width[0] / scale_s
    wt = width[1] / scale_t
    colour = a
    if kind == PLAIN:
        colour = a * (1.0 + contrast * _octaves(s, t, ti.max(ws, wt), seed))
    elif kind == CLOUD:
        share = _clamp01(0.5 + contrast * _octaves(s, t, ti.max(ws, wt), seed))
        colour = a * (1.0 - share) + b * share
    elif kind == TILES:
        tint = contrast * (_cells(s, t, ws, wt, seed) - 0.5)
        grain = 0.12 * _octaves(3.0 * s, 3.0 * t, 3.0 * ti.max(ws, wt), seed + 5)
        joint = 1.0 - (1.0 - _pulse(s, ws, _JOINT)) * (1.0 - _pulse(t, wt, _JOINT))
        colour = a * (1.0 + tint + grain) * (1.0 - joint) + b * joint
    elif kind == PLANKS:
        tint_joint = _planks(s, t, ws, wt, seed)
        grain = _octaves(4.0 * s, 3.0 * t, ti.max(4.0 * ws, 3.0 * wt), seed + 5)
        share = _clamp01(0.5 + contrast * (tint_joint[0] - 0.5 + 0.5 * grain))
        colour = (a * (1.0 - share) + b * share) * (1.0 - 0.5 * tint_joint[1])
    elif kind == BOOKS:
        colour = _books(s, 0.5 + 0.5 * st[1] / half[1], ws, 0.5 * width[1] / half[1], seed, a, b)
    elif kind == PICTURE:
        inside = ti.min(half[0] - ti.abs(st[0]), half[1] - ti.abs(st[1])) - _PICTURE_BORDER_M
        share = _clamp01(0.5 + inside / ti.max(ti.max(width[0], width[1]), 1e-3))
        colour = _picture(st[0], st[1], ti.max(width[0], width[1]), scale_s, seed, a, contrast) * share + b * (
            1.0 - share
        )
    elif kind == WEAVE:
        stripes = _pulse(s, ws, 0.5) + _pulse(t, wt, 0.5) - 1.0
        grain = _octaves(0.7 * s, 0.7 * t, 0.7 * ti.max(ws, wt), seed)
        share = _clamp01(0.5 + contrast * (0.5 * stripes + 0.8 * grain))
        colour = a * (1.0 - share) + b * share
    return colour
