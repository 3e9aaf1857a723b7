"""E_str in float64 NumPy, one Gaussian at a time."""

import numpy as np

from tgslam.geometry import matrix_from_quat_wxyz


def unit_areas(log_scale):
    """s1 s2 of each Gaussian [N]: the unit of Eq. 8, a constant to the gradient."""
    return np.exp(np.sort(log_scale, axis=1)[:, 1:].sum(1))


def planar(visible, plane_id, planes):
    """Which Gaussians take part [N]."""
    return np.array([
        bool(v) and 0 <= k < len(planes) and bool(planes[k, :3].any()) for v, k in zip(visible, plane_id, strict=True)
    ])  # fmt: skip


def geman_mcclure(x):
    """x^2 / 2 for small x; 1/2 at most."""
    return 0.5 * x**2 / (1.0 + x**2)


def parts(mean, log_scale, quat, areas, use, plane_id, planes, config):
    """Means of the three penalties over the Gaussians in `use`."""
    sums = np.zeros(3)
    for i in np.flatnonzero(use):
        s3, s2, s1 = np.sort(np.exp(log_scale[i]))
        axis = matrix_from_quat_wxyz(quat[i] / np.linalg.norm(quat[i]))[:, np.argmin(log_scale[i])]
        normal, offset = planes[plane_id[i], :3], planes[plane_id[i], 3]
        sums += (
            (s3 - config.expert.shape.thinness * np.sqrt(s1 * s2)) ** 2 / areas[i],
            1 - abs(axis @ normal),
            geman_mcclure((normal @ mean[i] + offset) / config.expert.shape.sigma_distance_m),
        )
    return dict(zip(("flat", "normal", "distance"), sums / max(use.sum(), 1), strict=True))


def value(*arguments):
    """lambda_str E_str; arguments as of `parts`."""
    config, means = arguments[-1], parts(*arguments)
    return config.lambda_str * (
        config.expert.shape.omega_flat * means["flat"]
        + config.expert.shape.omega_normal * means["normal"]
        + config.expert.shape.omega_distance * means["distance"]
    )
