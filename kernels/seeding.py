"""Which square cells of a frame one flat Gaussian can stand for."""

import taichi as ti

from tgslam.kernels.image import SPLIT, segment

nd = ti.types.ndarray


@ti.kernel
def plain_and_planar(
    colour: nd(ti.f32, ndim=3),  # [H, W, 3] RGB
    depth: nd(ti.f32, ndim=2),  # [H, W] m, 0 = none
    size: ti.i32,  # px, of a cell
    plain_std: ti.f32,  # a channel's standard deviation below which a cell has no texture
    planar_rms: ti.f32,  # 1/m, residual of inverse depth below which a cell is flat
    cells: nd(ti.i32, ndim=2),  # [rows, columns] out: 1 = plain and planar
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
                mean_colour = ti.Vector([0.0, 0.0, 0.0])
                for y in range(size):
                    for x in range(size):
                        z = depth[top + y, left + x]
                        missing += ti.select(z > 0.0, 0, 1)
                        w = 1.0 / ti.max(z, 1e-6)
                        mean += w
                        slope_x += w * (x - middle)
                        slope_y += w * (y - middle)
                        for c in ti.static(range(3)):
                            mean_colour[c] += colour[top + y, left + x, c]
                if missing == 0:
                    mean, mean_colour = mean * inverse_count, mean_colour * inverse_count
                    per_slope = 12.0 * inverse_count / ti.max(size * size - 1.0, 1.0)  # 1 / sum of (x - middle)^2
                    slope_x, slope_y = slope_x * per_slope, slope_y * per_slope
                    residual, variance = 0.0, ti.Vector([0.0, 0.0, 0.0])
                    for y in range(size):
                        for x in range(size):
                            fit = mean + slope_x * (x - middle) + slope_y * (y - middle)
                            off = 1.0 / depth[top + y, left + x] - fit
                            residual += off * off
                            for c in ti.static(range(3)):
                                d = colour[top + y, left + x, c] - mean_colour[c]
                                variance[c] += d * d
                    plain = variance.max() * inverse_count < plain_std * plain_std
                    planar = residual * inverse_count < planar_rms * planar_rms
                    good = ti.select(plain and planar, 1, 0)
            cells[row, column] = good
