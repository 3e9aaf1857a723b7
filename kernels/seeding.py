"""Which square cells of a frame one flat Gaussian can stand for."""

import taichi as ti

from tgslam.kernels.image import SPLIT, segment

nd = ti.types.ndarray

PLAIN_AND_PLANAR, ON_PLANE = 1, 2


@ti.kernel
def plain_and_planar(
    colour: nd(ti.f32, ndim=3),  # [H, W, 3] RGB
    depth: nd(ti.f32, ndim=2),  # [H, W] m, 0 = none
    plane_ids: nd(ti.i32, ndim=2),  # [H, W] -1 = on no plane
    size: ti.i32,  # px, of a cell
    plain_std: ti.f32,  # a channel's standard deviation below which a cell has no texture
    plane_std: ti.f32,  # likewise for a cell on one plane, once a linear trend is taken off
    planar_rms: ti.f32,  # 1/m, residual of inverse depth below which a cell is flat
    on_planes_only: ti.i32,  # 1 = cells that are not on one plane do not count
    cells: nd(ti.i32, ndim=2),  # [rows, columns] out: 0, PLAIN_AND_PLANAR or, if it is on one plane, ON_PLANE
):
    """Cells in which every pixel has depth, colours hardly vary and one plane explains the depth.

    A plane's inverse depth is affine in the pixel, and the fit on a regular grid has a closed form. Mean and fit come
    first, deviations from them second: differences of squares would not survive float32.
    """
    for s in range(cells.shape[0] * SPLIT):
        row, begin, end = segment(s, cells.shape[1])
        for column in range(begin, end):
            top, left = row * size, column * size
            good = 0
            if top + size <= depth.shape[0] and left + size <= depth.shape[1]:
                middle, inverse_count = 0.5 * (size - 1), 1.0 / (size * size)
                missing, mean, slope_x, slope_y = 0, 0.0, 0.0, 0.0
                mean_colour, trend_x = ti.Vector([0.0, 0.0, 0.0]), ti.Vector([0.0, 0.0, 0.0])
                trend_y = ti.Vector([0.0, 0.0, 0.0])
                plane, strangers = plane_ids[top, left], 0
                for y in range(size):
                    for x in range(size):
                        z = depth[top + y, left + x]
                        missing += ti.select(z > 0.0, 0, 1)
                        w = 1.0 / ti.max(z, 1e-6)
                        mean += w
                        slope_x += w * (x - middle)
                        slope_y += w * (y - middle)
                        strangers += ti.select(plane_ids[top + y, left + x] == plane, 0, 1)
                        for c in ti.static(range(3)):
                            value = colour[top + y, left + x, c]
                            mean_colour[c] += value
                            trend_x[c] += value * (x - middle)
                            trend_y[c] += value * (y - middle)
                on_plane = (plane >= 0) and (strangers == 0)
                if missing == 0 and (on_plane or on_planes_only == 0):
                    mean, mean_colour = mean * inverse_count, mean_colour * inverse_count
                    per_slope = 12.0 * inverse_count / ti.max(size * size - 1.0, 1.0)  # 1 / sum of (x - middle)^2
                    slope_x, slope_y = slope_x * per_slope, slope_y * per_slope
                    per_trend = ti.select(on_plane, per_slope, 0.0)
                    trend_x, trend_y = trend_x * per_trend, trend_y * per_trend
                    residual, variance = 0.0, ti.Vector([0.0, 0.0, 0.0])
                    for y in range(size):
                        for x in range(size):
                            fit = mean + slope_x * (x - middle) + slope_y * (y - middle)
                            off = 1.0 / depth[top + y, left + x] - fit
                            residual += off * off
                            for c in ti.static(range(3)):
                                d = colour[top + y, left + x, c] - mean_colour[c]
                                d -= trend_x[c] * (x - middle) + trend_y[c] * (y - middle)
                                variance[c] += d * d
                    limit = ti.select(on_plane, plane_std, plain_std)
                    plain = variance.max() * inverse_count < limit * limit
                    planar = residual * inverse_count < planar_rms * planar_rms
                    good = ti.select(plain and planar, ti.select(on_plane, ON_PLANE, PLAIN_AND_PLANAR), 0)
            cells[row, column] = good
