"""Depth images in float64 NumPy: which measurements their neighbours support."""

import numpy as np


def keep_supported(depth, sigma_per_m2, tolerance_sigmas, slope, min_neighbours):
    """Beyond the border the image is taken to go on as at the border."""
    around = np.pad(depth, 1, mode="edge")
    kept = np.zeros_like(depth)
    for i, j in np.argwhere(depth > 0):
        z = depth[i, j]
        others = np.delete(around[i : i + 3, j : j + 3].ravel(), 4)
        tolerance = tolerance_sigmas * sigma_per_m2 * z**2 + slope * z
        if ((others > 0) & (abs(others - z) < tolerance)).sum() >= min_neighbours:
            kept[i, j] = z
    return kept
