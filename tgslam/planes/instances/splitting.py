"""Whether the views of an instance show two surfaces that were taken for one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.config.plane_settings import PlanesConfig
from tgslam.planes.estimate import PlaneEstimate
from tgslam.planes.instances.views import Poses, Views


def minority(views: Views, plane: PlaneEstimate, poses: Poses, config: PlanesConfig) -> NDArray[np.bool_] | None:
    """Which of the views [N] of a plane show the less often seen of two surfaces; None where there is but one.

    Two surfaces that were taken for one are seen now at one depth, now at the other. Drift also parts the views in
    two, but into earlier and later ones: that is no reason to split.
    """
    least = config.confirm_views
    if len(views) < 2 * least:
        return None
    height = plane.heights_m(views.planes.transformed(views.poses(poses)).centroid)
    ordered = np.sort(height)
    gaps = np.diff(ordered)[least - 1 : len(ordered) - least]
    cut = least - 1 + int(np.argmax(gaps))
    upper: NDArray[np.bool_] = height > 0.5 * (ordered[cut] + ordered[cut + 1])
    spread = np.hypot(np.std(height[upper]), np.std(height[~upper]))
    gap = ordered[cut + 1] - ordered[cut]
    expert = config.expert
    if gap < expert.association.gate_sigmas * max(float(spread), expert.uncertainty.pose_sigma_m):
        return None
    turns = np.count_nonzero(np.diff(upper.astype(int)))  # views are in order of time
    if turns < least:
        return None
    return upper if upper.sum() * 2 <= len(upper) else ~upper
