"""Depth seen by its own camera, brought into the pixels of the colour camera.

The depth image is a surface of triangles between neighbouring pixels that agree in depth. Seen from the colour camera,
the nearest of what covers a pixel counts. Minima of bit patterns do not depend on the order in which they are taken.
"""

import taichi as ti

from tgslam.kernels.image import F1, F2, F3, SPLIT, segment

NOTHING = 0x7FFFFFFF  # as the bits of a depth: none, and beyond all
_NEAREST_M = 1e-3
_RIM = 1e-4  # of a triangle: what is just outside of it belongs to it, so that no seams open between neighbours

I2 = ti.types.ndarray(dtype=ti.i32, ndim=2)
vec3 = ti.types.vector(3, ti.f32)


@ti.kernel
def place(
    depth: F2,  # [H, W] m, depth camera, 0 = none
    rays: F3,  # [H, W, 2] x/z, y/z that its pixels look along
    T_cd: F2,  # [3, 4] depth camera to colour camera
    camera: F1,  # [4] fx, fy, cx, cy of the colour camera, px
    placed: F3,  # [H, W, 3] out: u, v px and z m in the colour camera; z = 0: nowhere
):
    """Where the measurements are for the colour camera."""
    for s in range(depth.shape[0] * SPLIT):
        y, begin, end = segment(s, depth.shape[1])
        for x in range(begin, end):
            z = depth[y, x]
            p = vec3(z * rays[y, x, 0], z * rays[y, x, 1], z)
            q = vec3(0.0)
            for r in ti.static(range(3)):
                q[r] = T_cd[r, 0] * p[0] + T_cd[r, 1] * p[1] + T_cd[r, 2] * p[2] + T_cd[r, 3]
            there = z > 0.0 and q[2] > _NEAREST_M
            inverse = 1.0 / ti.max(q[2], _NEAREST_M)
            placed[y, x, 0] = ti.select(there, camera[0] * q[0] * inverse + camera[2], 0.0)
            placed[y, x, 1] = ti.select(there, camera[1] * q[1] * inverse + camera[3], 0.0)
            placed[y, x, 2] = ti.select(there, q[2], 0.0)


@ti.func
def corner(placed: ti.template(), y, x):
    """u, v, z of a measurement."""
    return vec3(placed[y, x, 0], placed[y, x, 1], placed[y, x, 2])


@ti.func
def draw(a, b, c, nearest: ti.template()):
    """The triangle into the image: inverse depth is linear in it. One that is seen from behind is not seen."""
    height, width = nearest.shape[0], nearest.shape[1]
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if area > 1e-6:
        left = ti.max(ti.cast(ti.ceil(ti.min(a[0], b[0], c[0]) - _RIM), ti.i32), 0)
        right = ti.min(ti.cast(ti.floor(ti.max(a[0], b[0], c[0]) + _RIM), ti.i32), width - 1)
        top = ti.max(ti.cast(ti.ceil(ti.min(a[1], b[1], c[1]) - _RIM), ti.i32), 0)
        bottom = ti.min(ti.cast(ti.floor(ti.max(a[1], b[1], c[1]) + _RIM), ti.i32), height - 1)
        for v in range(top, bottom + 1):
            for u in range(left, right + 1):
                x, y = ti.cast(u, ti.f32) - a[0], ti.cast(v, ti.f32) - a[1]
                of_b = (x * (c[1] - a[1]) - (c[0] - a[0]) * y) / area
                of_c = ((b[0] - a[0]) * y - x * (b[1] - a[1])) / area
                of_a = 1.0 - of_b - of_c
                if of_a >= -_RIM and of_b >= -_RIM and of_c >= -_RIM:
                    z = 1.0 / (of_a / a[2] + of_b / b[2] + of_c / c[2])
                    ti.atomic_min(nearest[v, u], ti.bit_cast(z, ti.i32))


@ti.func
def agree(first, second, sigma_per_m2, tolerance_sigmas, slope):
    """Whether two neighbouring depths may be of one surface."""
    z = ti.min(first, second)
    return z > 0.0 and ti.abs(first - second) < (tolerance_sigmas * sigma_per_m2 * z + slope) * z


@ti.kernel
def draw_surfaces(
    depth: F2,  # [H, W] m, depth camera, 0 = none
    placed: F3,  # [H, W, 3] of `place`
    sigma_per_m2: ti.f32,
    tolerance_sigmas: ti.f32,
    slope: ti.f32,  # depth change to a neighbour that a steep surface may have, relative to depth
    nearest: I2,  # [h, w] in and out: bits of the depth of surfaces, colour camera
):
    """Triangles between three neighbours that agree."""
    for s in range((depth.shape[0] - 1) * SPLIT):
        y, begin, end = segment(s, depth.shape[1] - 1)
        for x in range(begin, end):
            # around the square, clockwise as the image shows it
            z = ti.Vector([depth[y, x], depth[y, x + 1], depth[y + 1, x + 1], depth[y + 1, x]])
            corners = ti.Matrix.rows(
                [corner(placed, y, x), corner(placed, y, x + 1), corner(placed, y + 1, x + 1), corner(placed, y + 1, x)]
            )
            whole = True
            for k in ti.static(range(4)):
                there = corners[k, 2] > 0.0
                whole = whole and there and agree(z[k], z[(k + 1) % 4], sigma_per_m2, tolerance_sigmas, slope)
            for k in ti.static(range(4)):  # the triangle without corner k + 3
                i, j, m = ti.static(k, (k + 1) % 4, (k + 2) % 4)
                there = corners[i, 2] > 0.0 and corners[j, 2] > 0.0 and corners[m, 2] > 0.0
                one = agree(z[i], z[j], sigma_per_m2, tolerance_sigmas, slope)
                one = one and agree(z[j], z[m], sigma_per_m2, tolerance_sigmas, slope)
                one = one and agree(z[m], z[i], sigma_per_m2, tolerance_sigmas, 2.0 * slope)
                if there and one and (not whole or ti.static(k % 2 == 0)):
                    a = vec3(corners[i, 0], corners[i, 1], corners[i, 2])
                    b = vec3(corners[j, 0], corners[j, 1], corners[j, 2])
                    c = vec3(corners[m, 0], corners[m, 1], corners[m, 2])
                    draw(a, b, c, nearest)


@ti.kernel
def draw_points(
    placed: F3,  # [H, W, 3] of `place`
    nearest: I2,  # [h, w] in and out: bits of the depth of points, colour camera
):
    """Each measurement into the pixel that it falls on."""
    for s in range(placed.shape[0] * SPLIT):
        y, begin, end = segment(s, placed.shape[1])
        for x in range(begin, end):
            p = corner(placed, y, x)
            u, v = ti.cast(ti.floor(p[0] + 0.5), ti.i32), ti.cast(ti.floor(p[1] + 0.5), ti.i32)
            if p[2] > 0.0 and 0 <= u < nearest.shape[1] and 0 <= v < nearest.shape[0]:
                ti.atomic_min(nearest[v, u], ti.bit_cast(p[2], ti.i32))


@ti.kernel
def nearest_of(
    surfaces: I2,  # [h, w] of `draw_surfaces`
    points: I2,  # [h, w] of `draw_points`
    sigma_per_m2: ti.f32,
    tolerance_sigmas: ti.f32,
    slope: ti.f32,
    depth: F2,  # [h, w] out: m, colour camera, 0 = none
):
    """Surfaces, and points where there is none or where one is clearly before it: single ones, and rims."""
    for s in range(depth.shape[0] * SPLIT):
        y, begin, end = segment(s, depth.shape[1])
        for x in range(begin, end):
            surface, point = ti.bit_cast(surfaces[y, x], ti.f32), ti.bit_cast(points[y, x], ti.f32)
            found = 0.0
            if points[y, x] != NOTHING:
                found = point
            if surfaces[y, x] != NOTHING:
                before = point < surface and not agree(point, surface, sigma_per_m2, tolerance_sigmas, slope)
                if points[y, x] == NOTHING or not before:
                    found = surface
            depth[y, x] = found
