"""Which ids hold on their planes, and what undecided pixels are mixtures of, from the definitions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from tgslam.camera import Camera
from tgslam.config.plane_settings import StructureConfig
from tgslam.planes.identity import codes
from tgslam.planes.identity.outline import Outline
from tgslam.types import Plane


def on_planes(
    ids: np.ndarray,
    depth_m: np.ndarray,
    T_wc: np.ndarray,
    camera: Camera,
    planes: Sequence[Plane],
    config: StructureConfig,
    sigma_per_m2: float,
) -> np.ndarray:
    """Plane by plane over the whole image; see `PlaneReader.on_planes`."""
    limits, result = config.expert.reading, np.full(ids.shape, -1, np.int32)
    points_w = camera.rays() * depth_m[..., None].astype(np.float64) @ T_wc[:3, :3].T + T_wc[:3, 3]
    limit_m = limits.read_distance_m + limits.read_sigmas * sigma_per_m2 * depth_m.astype(np.float64) ** 2
    for plane in planes:
        near = (ids == plane.id) & (np.abs(points_w @ plane.normal_w + plane.offset_m) <= limit_m)
        seen = Outline(plane, limits.read_margin_m).holds(points_w.reshape(-1, 3)).reshape(ids.shape)
        parts, _ = ndimage.label(near, np.ones((3, 3)))
        result[near & np.isin(parts, parts[near & seen])] = plane.id
    return result


def unmixed(ids: np.ndarray, embedding: np.ndarray, opacity: np.ndarray, config: StructureConfig) -> np.ndarray:
    """Pixel by pixel, with every pixel around as often as it occurs; see `PlaneReader.read`."""
    result, (height, width) = ids.copy(), ids.shape
    for v, u in zip(*np.nonzero((ids == -1) & (opacity >= config.expert.reading.read_opacity)), strict=True):
        rows, columns = (np.clip(at + np.array([-2, 0, 2]), 0, end - 1) for at, end in ((v, height), (u, width)))
        around = ids[np.ix_(rows, columns)].ravel()
        nearby = np.sort(np.append(np.delete(around, 4), -1))
        if nearby[-1] != -1:
            result[v, u] = codes.unmixed((embedding[v, u] / opacity[v, u])[None], nearby[None], config)[0]
    return result
