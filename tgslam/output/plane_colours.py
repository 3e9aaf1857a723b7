"""The map's Gaussians in the colours of their planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tgslam.types import Gaussians, Plane

_LUMINANCE = np.array([0.299, 0.587, 0.114], np.float32)
_PALE = 0.5  # of the brightness of what is on no plane


def in_plane_colours(gaussians: Gaussians, planes: Sequence[Plane]) -> Gaussians:
    """The same Gaussians, those on one of `planes` in its colour, all others in a dim grey of their own brightness."""
    grey = _PALE * gaussians.colour @ _LUMINANCE
    colour = np.repeat(grey[:, None], 3, axis=1).astype(np.float32)
    for plane in planes:
        colour[gaussians.plane_id == plane.id] = plane.colour
    return replace(gaussians, colour=colour)
