"""Exact ray casting of convex primitives given in the camera frame. A ray is t * (x, y, 1), so t is depth z in metres.

Every primitive has a local frame: `axes[i]` are its axes (rows) in the camera frame, `origin[i]` is the camera centre
in local coordinates, `half_m[i]` its half sizes. Quads lie in local z = 0; boxes, ellipsoids and cylinders (axis z) are
centred on the local origin. `meta[i]` is (shape, material, first plane label, layer): a primitive of layer > 0 is
painted on another and wins over it.
"""

import taichi as ti

from tgslam.kernels.procedural import surface_colour

QUAD, BOX, ELLIPSOID, CYLINDER = range(4)  # shapes

TILE_PX = 16  # a side of the squares for which primitives are listed
NO_HIT = 1e30  # m, in place of a depth
LAYER_LEAD = 3e-4  # relative depth by which a layer wins over the one below
_TINY = 1e-9  # in place of a zero divisor
_MIN_COSINE = 0.03  # bounds the footprint at grazing angles
_EDGE_SHADE_M = 0.2  # reach of the darkening towards corners
_OCCLUSION_M = 0.09  # how far in front of a surface its occlusion is looked up
_OCCLUSION = 0.9  # darkening where everything around is solid
_SKY = (0.55, 0.62, 0.7)  # RGB of rays that hit nothing

Ints2 = ti.types.ndarray(dtype=ti.i32, ndim=2)
Ints1 = ti.types.ndarray(dtype=ti.i32, ndim=1)
Floats3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
Floats1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
Floats2 = ti.types.ndarray(dtype=ti.f32, ndim=2)


@ti.func
def _row(array: ti.template(), i: ti.i32) -> ti.math.vec3:
    return ti.math.vec3(array[i, 0], array[i, 1], array[i, 2])


@ti.func
def _to_local(axes: ti.template(), i: ti.i32, v: ti.math.vec3) -> ti.math.vec3:
    result = ti.math.vec3(0.0)
    for k in ti.static(range(3)):
        result[k] = axes[i, k, 0] * v[0] + axes[i, k, 1] * v[1] + axes[i, k, 2] * v[2]
    return result


@ti.kernel
def bin_primitives(
    axes: Floats3,  # [N, 3, 3]
    origin: Floats2,  # [N, 3] m
    half_m: Floats2,  # [N, 3] m
    fx: ti.f32,
    fy: ti.f32,
    cx: ti.f32,
    cy: ti.f32,
    tiles_x: ti.i32,
    counts: Ints1,  # [tiles] out
    lists: Ints2,  # [tiles, N] out: primitives that may be seen in the tile, ascending
):
    """List for each tile the primitives whose bounding boxes reach into its frustum."""
    for tile in range(counts.shape[0]):
        left = ((tile % tiles_x) * TILE_PX - 0.5 - cx) / fx
        top = ((tile // tiles_x) * TILE_PX - 0.5 - cy) / fy
        sides = ti.Matrix(
            [
                [-1.0, 0.0, left],
                [1.0, 0.0, -left - TILE_PX / fx],
                [0.0, -1.0, top],
                [0.0, 1.0, -top - TILE_PX / fy],
            ]
        )
        count = 0
        for i in range(axes.shape[0]):
            centre = -_row(origin, i)
            half = _row(half_m, i)
            outside = -NO_HIT
            for side in ti.static(range(4)):
                n = _to_local(axes, i, ti.math.vec3(sides[side, 0], sides[side, 1], sides[side, 2]))
                outside = ti.max(outside, n.dot(centre) - ti.abs(n).dot(half))
            lists[tile, count] = i
            if outside <= 0.0:
                count += 1
        counts[tile] = count


@ti.func
def _nonzero(x: ti.f32) -> ti.f32:
    return ti.select(ti.abs(x) < _TINY, _TINY, x)


@ti.func
def _slab(o: ti.f32, d: ti.f32, half: ti.f32) -> ti.math.vec2:
    """Interval of t in which |o + t d| <= half."""
    inv = 1.0 / _nonzero(d)
    t0 = (-half - o) * inv
    t1 = (half - o) * inv
    return ti.math.vec2(ti.min(t0, t1), ti.max(t0, t1))


@ti.func
def _round(o: ti.math.vec3, d: ti.math.vec3) -> ti.math.vec2:
    """Interval of t within the unit sphere, from the point of closest approach (stable in float32); empty if missed."""
    dd = ti.max(d.dot(d), _TINY)
    nearest = -o.dot(d) / dd
    p = o + nearest * d
    rest = 1.0 - p.dot(p)
    reach = ti.sqrt(ti.max(rest, 0.0) / dd)
    return ti.select(rest > 0.0, ti.math.vec2(nearest - reach, nearest + reach), ti.math.vec2(NO_HIT, -NO_HIT))


@ti.func
def _interval(shape: ti.i32, o: ti.math.vec3, d: ti.math.vec3, half: ti.math.vec3) -> ti.math.vec2:
    """Interval of t inside the primitive, given the ray in its local frame."""
    span = ti.math.vec2(NO_HIT, -NO_HIT)
    if shape == QUAD:
        t = -o[2] / _nonzero(d[2])
        if ti.abs(o[0] + t * d[0]) <= half[0] and ti.abs(o[1] + t * d[1]) <= half[1]:
            span = ti.math.vec2(t, t)
    elif shape == BOX:
        sx = _slab(o[0], d[0], half[0])
        sy = _slab(o[1], d[1], half[1])
        sz = _slab(o[2], d[2], half[2])
        span = ti.math.vec2(ti.max(sx[0], ti.max(sy[0], sz[0])), ti.min(sx[1], ti.min(sy[1], sz[1])))
    elif shape == ELLIPSOID:
        span = _round(o / half, d / half)
    else:
        side = _round(
            ti.math.vec3(o[0] / half[0], o[1] / half[1], 0.0), ti.math.vec3(d[0] / half[0], d[1] / half[1], 0.0)
        )
        caps = _slab(o[2], d[2], half[2])
        span = ti.math.vec2(ti.max(side[0], caps[0]), ti.min(side[1], caps[1]))
    return span


@ti.func
def _first_hit(
    tile: ti.i32,
    ray: ti.math.vec3,
    meta: ti.template(),
    axes: ti.template(),
    origin: ti.template(),
    half_m: ti.template(),
    near_m: ti.template(),
    counts: ti.template(),
    lists: ti.template(),
):
    """(depth m or NO_HIT, primitive or -1) of the nearest surface in front of the camera."""
    best_key = NO_HIT
    best_t = NO_HIT
    best = -1
    for entry in range(counts[tile]):
        i = lists[tile, entry]
        if near_m[i] > best_t:
            break  # so is every later one
        span = _interval(meta[i, 0], _row(origin, i), _to_local(axes, i, ray), _row(half_m, i))
        key = span[0] * (1.0 - LAYER_LEAD * meta[i, 3])
        if span[0] <= span[1] and span[0] > 0.0 and key < best_key:
            best_key = key
            best_t = span[0]
            best = i
    return best_t, best


@ti.func
def _flat_axis(shape: ti.i32, p: ti.math.vec3, half: ti.math.vec3) -> ti.i32:
    """Local axis of the flat face that p lies on, -1 on a curved surface."""
    axis = -1
    if shape == QUAD:
        axis = 2
    elif shape == BOX:
        q = ti.abs(p) - half
        axis = 0
        if q[1] > q[0]:
            axis = 1
        if q[2] > ti.max(q[0], q[1]):
            axis = 2
    elif shape == CYLINDER:
        radial = ti.sqrt((p[0] / half[0]) ** 2 + (p[1] / half[1]) ** 2)
        if (ti.abs(p[2]) - half[2]) > (radial - 1.0) * half[0]:
            axis = 2
    return axis


@ti.func
def _local_normal(shape: ti.i32, axis: ti.i32, p: ti.math.vec3, half: ti.math.vec3) -> ti.math.vec3:
    """Outward unit normal at p, local frame."""
    n = ti.math.vec3(0.0, 0.0, 1.0)
    if axis < 0:
        g = p / (half * half)
        if shape == CYLINDER:
            g[2] = 0.0
        n = g / ti.max(g.norm(), _TINY)
    elif shape != QUAD:
        for k in ti.static(range(3)):
            n[k] = ti.select(axis == k, ti.select(p[k] > 0.0, 1.0, -1.0), 0.0)
    return n


@ti.func
def _label(shape: ti.i32, axis: ti.i32, p: ti.math.vec3, first: ti.i32) -> ti.i32:
    """Plane label: quads have one, boxes six (-x, +x, -y, +y, -z, +z), cylinders two caps (-z, +z).

    None where first < 0.
    """
    label = -1
    if shape == QUAD:
        label = first
    elif axis >= 0 and first >= 0:
        side = ti.select(p[axis] > 0.0, 1, 0)
        label = first + ti.select(shape == BOX, 2 * axis, 0) + side
    return label


@ti.kernel
def cast(
    meta: Ints2,  # [N, 4]
    axes: Floats3,  # [N, 3, 3]
    origin: Floats2,  # [N, 3] m
    half_m: Floats2,  # [N, 3] m
    near_m: Floats1,  # [N] m, lower bound of the primitive's depth, ascending
    counts: Ints1,  # [tiles]
    lists: Ints2,  # [tiles, N]
    fx: ti.f32,
    fy: ti.f32,
    cx: ti.f32,
    cy: ti.f32,
    depth_m: Floats2,  # [H, W] out, z in m, 0 = nothing hit
    primitive: Ints2,  # [H, W] out, -1 = nothing hit
    label: Ints2,  # [H, W] out, plane label, -1 = no plane
    cosine: Floats2,  # [H, W] out, |cos| of the angle between ray and normal
):
    """Depth, primitive, plane label and incidence of the ray through each pixel's centre."""
    height = depth_m.shape[0]
    width = depth_m.shape[1]
    tiles_x = (width + TILE_PX - 1) // TILE_PX
    for tile, in_row, in_column in ti.ndrange(counts.shape[0], TILE_PX, TILE_PX):
        row = (tile // tiles_x) * TILE_PX + in_row
        column = (tile % tiles_x) * TILE_PX + in_column
        if row >= height or column >= width:
            continue
        ray = ti.math.vec3((column - cx) / fx, (row - cy) / fy, 1.0)
        t, i = _first_hit(tile, ray, meta, axes, origin, half_m, near_m, counts, lists)
        depth_m[row, column] = 0.0
        label[row, column] = -1
        cosine[row, column] = 0.0
        primitive[row, column] = i
        if i >= 0:
            d = _to_local(axes, i, ray)
            half = _row(half_m, i)
            p = _row(origin, i) + t * d
            axis = _flat_axis(meta[i, 0], p, half)
            depth_m[row, column] = t
            label[row, column] = _label(meta[i, 0], axis, p, meta[i, 2])
            cosine[row, column] = ti.abs(_local_normal(meta[i, 0], axis, p, half).dot(d)) / ray.norm()


@ti.func
def _surface_coordinates(
    shape: ti.i32,
    axis: ti.i32,
    p: ti.math.vec3,
    n: ti.math.vec3,
    half: ti.math.vec3,
    dpu: ti.math.vec3,
    dpv: ti.math.vec3,
):
    """((s, t) m, half sizes m, footprint m) on the surface; dpu, dpv: the hit point's motion per pixel, local frame."""
    st = ti.math.vec2(p[0], p[1])
    size = ti.math.vec2(half[0], half[1])
    width = ti.math.vec2(ti.abs(dpu[0]) + ti.abs(dpv[0]), ti.abs(dpu[1]) + ti.abs(dpv[1]))
    spread_z = ti.abs(dpu[2]) + ti.abs(dpv[2])
    if axis == 0:
        st = ti.math.vec2(p[1], p[2])
        size = ti.math.vec2(half[1], half[2])
        width = ti.math.vec2(width[1], spread_z)
    elif axis == 1:
        st = ti.math.vec2(p[0], p[2])
        size = ti.math.vec2(half[0], half[2])
        width = ti.math.vec2(width[0], spread_z)
    elif axis < 0:
        if shape == CYLINDER:
            st = ti.math.vec2(ti.atan2(p[1], p[0]) * half[0], p[2])
            size = ti.math.vec2(ti.math.pi * half[0], half[2])
            along = ti.math.vec3(-n[1], n[0], 0.0)
            width = ti.math.vec2(ti.abs(dpu.dot(along)) + ti.abs(dpv.dot(along)), spread_z)
        else:
            st = ti.math.vec2(p[0] + 0.5 * p[2], p[1] - 0.4 * p[2])
            width = ti.math.vec2(width[0] + spread_z, width[1] + spread_z)
    return st, size, width


@ti.func
def _occlusion(grid: ti.template(), light: ti.template(), point: ti.math.vec3) -> ti.f32:
    """The occlusion grid [Z, Y, X] at a camera-frame point, trilinear; rows 3 to 5 of `light` map it to grid units."""
    low = ti.Vector([0, 0, 0])
    share = ti.math.vec3(0.0)
    for k in ti.static(range(3)):
        x = light[3 + k, 0] * point[0] + light[3 + k, 1] * point[1] + light[3 + k, 2] * point[2] + light[3 + k, 3]
        x = ti.min(ti.max(x, 0.0), grid.shape[2 - k] - 1.001)
        low[k] = ti.cast(ti.floor(x), ti.i32)
        share[k] = x - ti.floor(x)
    total = 0.0
    for dz, dy, dx in ti.static(ti.ndrange(2, 2, 2)):
        weight = ti.abs(1 - dx - share[0]) * ti.abs(1 - dy - share[1]) * ti.abs(1 - dz - share[2])
        total += weight * grid[low[2] + dz, low[1] + dy, low[0] + dx]
    return total


@ti.func
def _lit(
    albedo: ti.math.vec3,
    point: ti.math.vec3,
    n: ti.math.vec3,
    light: ti.template(),
    occlusion: ti.template(),
    edge_m: ti.f32,
    edge_shade: ti.f32,
) -> ti.math.vec3:
    """Ambient light from above, a distant fill and a lamp, all Lambertian, darker towards a flat surface's edges.

    light [6, 4], camera frame: (up, ambient), (direction to the fill, its strength), (lamp m, its strength), and the
    three rows that take a point to the units of the occlusion grid.
    """
    to_lamp = ti.math.vec3(light[2, 0], light[2, 1], light[2, 2]) - point
    distance = ti.max(to_lamp.norm(), 0.05)
    up = n[0] * light[0, 0] + n[1] * light[0, 1] + n[2] * light[0, 2]
    fill = n[0] * light[1, 0] + n[1] * light[1, 1] + n[2] * light[1, 2]
    lamp = ti.max(n.dot(to_lamp) / distance, 0.0) / (1.0 + 0.08 * distance * distance)
    level = light[0, 3] * (1.0 + 0.15 * up) + light[1, 3] * (0.5 + 0.5 * fill) + light[2, 3] * lamp
    level *= 1.0 - _OCCLUSION * _occlusion(occlusion, light, point + _OCCLUSION_M * n)
    return albedo * level * (1.0 - edge_shade * ti.exp(-edge_m / _EDGE_SHADE_M))


@ti.func
def _shade_hit(
    i: ti.i32,
    t: ti.f32,
    ray: ti.math.vec3,
    fx: ti.f32,
    fy: ti.f32,
    meta: ti.template(),
    axes: ti.template(),
    origin: ti.template(),
    half_m: ti.template(),
    material_kind: ti.template(),
    material: ti.template(),
    light: ti.template(),
    occlusion: ti.template(),
) -> ti.math.vec3:
    """Colour [3] of primitive i where the ray meets it."""
    shape = meta[i, 0]
    m = meta[i, 1]
    half = _row(half_m, i)
    d = _to_local(axes, i, ray)
    p = _row(origin, i) + t * d
    axis = _flat_axis(shape, p, half)
    n = _local_normal(shape, axis, p, half)
    n = ti.select(n.dot(d) > 0.0, -n, n)
    approach = ti.min(n.dot(d), -_MIN_COSINE * ray.norm())
    du = ti.math.vec3(axes[i, 0, 0], axes[i, 1, 0], axes[i, 2, 0]) / fx
    dv = ti.math.vec3(axes[i, 0, 1], axes[i, 1, 1], axes[i, 2, 1]) / fy
    dpu = t * (du - d * (n.dot(du) / approach))
    dpv = t * (dv - d * (n.dot(dv) / approach))
    st, size, width = _surface_coordinates(shape, axis, p, n, half, dpu, dpv)
    albedo = surface_colour(
        material_kind[m, 0],
        material_kind[m, 1],
        ti.math.vec3(material[m, 0], material[m, 1], material[m, 2]),
        ti.math.vec3(material[m, 3], material[m, 4], material[m, 5]),
        material[m, 6],
        material[m, 7],
        material[m, 8],
        st,
        size,
        width,
    )
    edge_m = ti.min(size[0] - ti.abs(st[0]), size[1] - ti.abs(st[1]))
    n_camera = ti.math.vec3(0.0)
    for k in ti.static(range(3)):
        n_camera[k] = axes[i, 0, k] * n[0] + axes[i, 1, k] * n[1] + axes[i, 2, k] * n[2]
    return _lit(
        albedo, t * ray, n_camera, light, occlusion, ti.max(edge_m, 0.0), ti.select(axis >= 0, material[m, 9], 0.0)
    )


@ti.func
def _is_edge(primitive: ti.template(), label: ti.template(), row: ti.i32, column: ti.i32) -> bool:
    edge = False
    for dr, dc in ti.static(((-1, 0), (0, -1), (0, 1), (1, 0))):
        r = ti.min(ti.max(row + dr, 0), primitive.shape[0] - 1)
        c = ti.min(ti.max(column + dc, 0), primitive.shape[1] - 1)
        if primitive[r, c] != primitive[row, column] or label[r, c] != label[row, column]:
            edge = True
    return edge


@ti.kernel
def shade(
    meta: Ints2,  # [N, 4]
    axes: Floats3,  # [N, 3, 3]
    origin: Floats2,  # [N, 3] m
    half_m: Floats2,  # [N, 3] m
    material_kind: Ints2,  # [M, 2] kind, seed
    material: Floats2,  # [M, 10] colour a, colour b, scale s m, scale t m, contrast, edge shade
    light: Floats2,  # [6, 4] see _lit, camera
    occlusion: Floats3,  # [Z, Y, X] share of the neighbourhood that is solid
    near_m: Floats1,  # [N] m, lower bound of the primitive's depth, ascending
    counts: Ints1,  # [tiles]
    lists: Ints2,  # [tiles, N]
    fx: ti.f32,
    fy: ti.f32,
    cx: ti.f32,
    cy: ti.f32,
    depth_m: Floats2,  # [H, W] of `cast`
    primitive: Ints2,  # [H, W] of `cast`
    label: Ints2,  # [H, W] of `cast`
    colour: Floats3,  # [H, W, 3] out, in [0, 1]
):
    """Colour of each pixel: band-limited inside surfaces, the mean of 2 x 2 rays where surfaces meet."""
    height = depth_m.shape[0]
    width = depth_m.shape[1]
    tiles_x = (width + TILE_PX - 1) // TILE_PX
    for tile, in_row, in_column in ti.ndrange(counts.shape[0], TILE_PX, TILE_PX):
        row = (tile // tiles_x) * TILE_PX + in_row
        column = (tile % tiles_x) * TILE_PX + in_column
        if row >= height or column >= width:
            continue
        samples = 1
        if _is_edge(primitive, label, row, column):
            samples = 4
        total = ti.math.vec3(0.0)
        for k in range(samples):
            t = depth_m[row, column]
            i = primitive[row, column]
            ray = ti.math.vec3((column - cx) / fx, (row - cy) / fy, 1.0)
            if samples == 4:
                ray[0] += (0.5 * (k % 2) - 0.25) / fx
                ray[1] += (0.5 * (k // 2) - 0.25) / fy
                t, i = _first_hit(tile, ray, meta, axes, origin, half_m, near_m, counts, lists)
            sample = ti.math.vec3(_SKY[0], _SKY[1], _SKY[2])
            if i >= 0:
                sample = _shade_hit(
                    i, t, ray, fx, fy, meta, axes, origin, half_m, material_kind, material, light, occlusion
                )
            total += ti.min(ti.max(sample, 0.0), 1.0)
        for channel in ti.static(range(3)):
            colour[row, column, channel] = total[channel] / samples
