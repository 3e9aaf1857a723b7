"""Relaxation of colours and depths in float64 NumPy, one Gaussian at a time."""

import numpy as np

from tgslam.geometry import inverse


def relax(visible, gradient, z, T_cw, steps, floors, max_shift, colour, mean):
    """New colours [N, 3] and means [N, 3].

    gradient: dict of colour [N, 3], depth [N] and the curvatures w_colour, w_depth [N]. steps, floors: (colour, depth).
    """
    colour, mean = colour.copy(), mean.copy()
    centre = inverse(T_cw)[:3, 3]
    for i in np.flatnonzero(visible):
        step = steps[0] * gradient["colour"][i] / (gradient["w_colour"][i] + floors[0])
        colour[i] = np.clip(colour[i] - step, 0, 1)
        limit = max_shift * z[i] ** 2
        shift = np.clip(-steps[1] * gradient["depth"][i] / (gradient["w_depth"][i] + floors[1]), -limit, limit)
        mean[i] = centre + (mean[i] - centre) * (1 + shift / z[i])
    return colour, mean
