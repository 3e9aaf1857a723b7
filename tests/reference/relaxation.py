"""Relaxation of colours in float64 NumPy, one Gaussian at a time."""

import numpy as np


def relax(visible, grad_colour, curvature, step, floor, colour):
    """New colours [N, 3]. grad_colour: [N, 3]. curvature: [N], of the colours."""
    colour = colour.copy()
    for i in np.flatnonzero(visible):
        colour[i] = np.clip(colour[i] - step * grad_colour[i] / (curvature[i] + floor), 0, 1)
    return colour
