"""Sums for the motion between two keyframes: heights of points over their planes, and distances of points from a depth
image. A parallel iteration takes a block of points and writes its own row of sums.
"""

import taichi as ti

BLOCK = 64  # points
HEIGHT_SUMS = 10  # w, wu, wv, wuu, wuv, wvv, wh, wuh, wvh over the tangents' u and v and the height h; and points
UNKNOWNS = 6  # rotation 3, translation 3
TRIANGLE = UNKNOWNS * (UNKNOWNS + 1) // 2
SQUARES = TRIANGLE + UNKNOWNS  # sum of robustly weighted squared residuals
MATCHES = SQUARES + 1
MATCH_SUMS = MATCHES + 1
_ROBUST = 0.25  # Cauchy's weight 1 / (1 + this e^2): half at 2 sigma
_REACH = 2  # px, to the pixels that a normal is taken from
_STEEP = 0.1  # neighbours farther in depth than this share of it are another surface
_MIN_COSINE = 0.2  # surfaces seen at a smaller one do not match

F1 = ti.types.ndarray(dtype=ti.f32, ndim=1)
F2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
F3 = ti.types.ndarray(dtype=ti.f32, ndim=3)
I1 = ti.types.ndarray(dtype=ti.i32, ndim=1)
vec3 = ti.types.vector(3, ti.f32)


@ti.func
def point_at(points: ti.template(), k):
    """Row k of an array of points."""
    return vec3(points[k, 0], points[k, 1], points[k, 2])


@ti.kernel
def plane_heights(
    points: F2,  # [N, 3] m, camera
    row: I1,  # [N] row of `planes`
    planes: F2,  # [P, 12] camera: normal, d, then each tangent with where the centroid lies along it, m
    depth_sigma: ti.f32,  # sigma_z = this * z^2, 1/m
    model_sigma: ti.f32,  # m, of a surface about its plane
    partial: F3,  # [blocks, P, 10] out
):
    """Weighted moments of the heights of points over their planes, for fitting those anew."""
    for part in range(partial.shape[0] * partial.shape[1]):
        block, plane = part // partial.shape[1], part % partial.shape[1]
        normal = vec3(planes[plane, 0], planes[plane, 1], planes[plane, 2])
        first = vec3(planes[plane, 4], planes[plane, 5], planes[plane, 6])
        second = vec3(planes[plane, 8], planes[plane, 9], planes[plane, 10])
        sums = ti.Vector([0.0] * HEIGHT_SUMS)
        for k in range(block * BLOCK, ti.min((block + 1) * BLOCK, points.shape[0])):
            if row[k] == plane:
                p = point_at(points, k)
                along = normal.dot(p)
                h = along + planes[plane, 3]
                u, v = first.dot(p) - planes[plane, 7], second.dot(p) - planes[plane, 11]
                sigma = depth_sigma * p[2] * along
                variance = sigma * sigma + model_sigma * model_sigma
                w = 1.0 / (variance + _ROBUST * h * h)
                sums += ti.Vector([w, w * u, w * v, w * u * u, w * u * v, w * v * v, w * h, w * u * h, w * v * h, 1.0])
        for c in ti.static(range(HEIGHT_SUMS)):
            partial[block, plane, c] = sums[c]


@ti.func
def surface_point(depth: ti.template(), u, v, camera: ti.template()):
    """Of a pixel; z = 0 where it has no depth."""
    z = depth[v, u]
    return vec3(z * (u - camera[2]) / camera[0], z * (v - camera[3]) / camera[1], z)


@ti.func
def surface_normal(depth: ti.template(), u, v, camera: ti.template()):
    """Unit, towards the camera, from the pixels around one that is no nearer to the border; 0 at an edge."""
    centre = surface_point(depth, u, v, camera)
    left, right = surface_point(depth, u - _REACH, v, camera), surface_point(depth, u + _REACH, v, camera)
    above, below = surface_point(depth, u, v - _REACH, camera), surface_point(depth, u, v + _REACH, camera)
    least = ti.min(ti.min(left[2], right[2]), ti.min(above[2], below[2]))
    most = ti.max(ti.max(left[2], right[2]), ti.max(above[2], below[2]))
    normal = vec3(0.0)
    if centre[2] > 0.0 and least > (1.0 - _STEEP) * centre[2] and most < (1.0 + _STEEP) * centre[2]:
        across = (below - above).cross(right - left)
        length = across.norm()
        if length > 0.0 and ti.abs(across.dot(centre)) > _MIN_COSINE * length * centre.norm():
            normal = across * ti.select(across.dot(centre) > 0.0, -1.0 / length, 1.0 / length)
    return normal


@ti.kernel
def surface_distances(
    points: F2,  # [N, 3] m, camera j
    T_ij: F2,  # [3, 4]
    depth: F2,  # [H, W] m, camera i, 0 = none
    camera: F1,  # [4] fx, fy, cx, cy, px
    depth_sigma: ti.f32,  # sigma_z = this * z^2, 1/m
    model_sigma: ti.f32,  # m
    limit: ti.f32,  # m: farther surfaces do not match
    partial: F2,  # [blocks, 29] out: upper triangle of A by rows, b, squares, matches
):
    """Normal equations, in a left perturbation of T_ji, of the distances of points from a depth image's surface."""
    height, width = depth.shape[0], depth.shape[1]
    for block in range(partial.shape[0]):
        sums = ti.Vector([0.0] * MATCH_SUMS)
        for k in range(block * BLOCK, ti.min((block + 1) * BLOCK, points.shape[0])):
            p = point_at(points, k)
            q = vec3(0.0)
            for r in ti.static(range(3)):
                q[r] = T_ij[r, 0] * p[0] + T_ij[r, 1] * p[1] + T_ij[r, 2] * p[2] + T_ij[r, 3]
            if q[2] > 0.1:
                u = ti.cast(ti.floor(camera[0] * q[0] / q[2] + camera[2] + 0.5), ti.i32)
                v = ti.cast(ti.floor(camera[1] * q[1] / q[2] + camera[3] + 0.5), ti.i32)
                if _REACH <= u < width - _REACH and _REACH <= v < height - _REACH:
                    normal = surface_normal(depth, u, v, camera)
                    gap = q - surface_point(depth, u, v, camera)
                    if normal.dot(normal) > 0.5 and gap.norm() < limit:
                        e = normal.dot(gap)
                        sigma = depth_sigma * q[2] * normal.dot(q)
                        variance = 2.0 * sigma * sigma + model_sigma * model_sigma
                        w = 1.0 / (variance + _ROBUST * e * e)
                        m = vec3(0.0)
                        for c in ti.static(range(3)):
                            m[c] = T_ij[0, c] * normal[0] + T_ij[1, c] * normal[1] + T_ij[2, c] * normal[2]
                        turn = p.cross(m)
                        j = ti.Vector([-turn[0], -turn[1], -turn[2], -m[0], -m[1], -m[2]])
                        for a in ti.static(range(UNKNOWNS)):
                            for b in ti.static(range(a, UNKNOWNS)):
                                sums[ti.static(a * UNKNOWNS - a * (a - 1) // 2 + b - a)] += w * j[a] * j[b]
                            sums[TRIANGLE + a] += w * e * j[a]
                        sums[SQUARES] += w * e * e
                        sums[MATCHES] += 1.0
        for c in ti.static(range(MATCH_SUMS)):
            partial[block, c] = sums[c]
