"""Which planes lend their normals to a keyframe that frames are aligned to, where noise would hold the camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.geometry import inverse
from tgslam.map.world import Map
from tgslam.tracking.references import NO_PLANES

# Of the pixels' normals, that planes give the camera in each direction at least: measured normals are off by 0.1 to 0.2
# rad, so that noise alone gives 1 to 3 %
_HELD = 0.05


def planes_seen(world: Map, number: int) -> NDArray[np.float64]:
    """[P, 4] n . x + d = 0 in the world: the PGIs that a keyframe saw."""
    seen = world.planes_seen_from(number)
    return np.array([(*plane.normal_w, plane.offset_m) for plane in seen]).reshape(-1, 4)


def steadying_planes(world: Map, number: int) -> NDArray[np.float64]:
    """[P, 4] n . x + d = 0 in a keyframe's camera: the PGIs whose normals its surfaces take in tracking.

    Those are all that it saw, if together they leave a direction free, along which noise of measured normals would
    hold the camera; else none, since measured normals follow what real surfaces stray from planes by. number: the
    keyframe's.
    """
    if not world.planes or _least_held(world, number) >= _HELD:
        return NO_PLANES
    return planes_seen(world, number) @ inverse(world.keyframes[number].T_cw)


def _least_held(world: Map, number: int) -> float:
    """Share of a keyframe's depth whose normals point in the direction in which the fewest do.

    What is on no plane is taken to face all directions alike.
    """
    labels = world.keyframes[number].labels
    assert world.planes is not None and labels is not None
    normals = world.planes.table.planes_w[:, :3]
    counts, named = np.bincount(labels.places.ravel(), minlength=len(labels.ids)), labels.ids >= 0
    pixels = np.zeros(len(normals), np.int64)
    pixels[labels.ids[named]] = counts[named]
    pixels *= normals.any(axis=1)
    measured = max(int(np.count_nonzero(world.keyframes[number].depth_m())), 1)
    others = max(measured - int(pixels.sum()), 0)
    moments = np.einsum("n,ni,nj->ij", pixels, normals, normals)
    return (float(np.linalg.eigvalsh(moments)[0]) + others / 3.0) / measured
