"""How surfaces stand to each other: much of what people build is parallel to walls and floors."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tgslam.config.plane_settings import PlanesConfig
from tgslam.planes.instances.instance import NO_ID, PlanarInstance


def stands_as_known(instance: PlanarInstance, known: Iterable[PlanarInstance], config: PlanesConfig) -> bool:
    """Whether an instance is parallel to a large PGI, from whichever side each of them is seen.

    What only looks like a plane, such as a strip of a round surface or one that two others share, may be turned any
    way: within two degrees of one of three walls, one of some five hundred of them is by chance.
    """
    allowed_rad = config.expert.association.gate_sigmas * config.expert.reliability.reliable_angle_rad
    return any(
        np.linalg.norm(np.cross(instance.normal_w, other.normal_w)) <= allowed_rad
        for other in known
        if other is not instance and other.id != NO_ID and other.area_m2 >= config.expert.gaps.across_area_m2
    )
