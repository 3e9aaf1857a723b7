"""Ambient occlusion baked into a grid over a room: how full the neighbourhood of each point is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tgslam.kernels.raycast import BOX, CYLINDER, QUAD

VOXEL_M = 0.06  # finer than what is blurred
_BLUR_M = 0.13  # standard deviation: how far into a room a corner is seen to be dark


@dataclass(frozen=True)
class OcclusionGrid:
    """Share of the neighbourhood that solids fill, at points low_w + VOXEL_M * (x, y, z)."""

    share: NDArray[np.float32]  # [Z, Y, X] in [0, 1]
    low_w: NDArray[np.float64]  # [3] m, world


def unoccluded() -> OcclusionGrid:
    """The grid of an empty world, of any size."""
    return OcclusionGrid(np.zeros((2, 2, 2), np.float32), np.zeros(3))


def bake(
    shape: NDArray[np.int32],
    axes_w: NDArray[np.float64],
    centre_w: NDArray[np.float64],
    half_m: NDArray[np.float64],
    radius_m: NDArray[np.float64],
) -> OcclusionGrid:
    """The grid of primitives as `Scene` holds them: shape [N], axes [N, 3, 3], centre, half [N, 3], radius [N] m."""
    low_w = (centre_w - np.abs(np.einsum("nij,ni->nj", axes_w, half_m))).min(axis=0) - VOXEL_M
    high_w = (centre_w + radius_m[:, None])[shape != QUAD].max(axis=0, initial=0.0) + VOXEL_M
    size = np.ceil((high_w - low_w) / VOXEL_M).astype(int) + 1
    share = np.zeros(size, np.float32)  # x, y, z
    for i in np.flatnonzero(shape != QUAD):
        first = np.floor((centre_w[i] - radius_m[i] - low_w) / VOXEL_M).astype(int).clip(0)
        last = np.ceil((centre_w[i] + radius_m[i] - low_w) / VOXEL_M).astype(int) + 1
        block = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        ticks = [low_w[k] + VOXEL_M * np.arange(block[k].start, min(block[k].stop, size[k])) for k in range(3)]
        offset_w = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1) - centre_w[i]
        filled = _filled_share(int(shape[i]), offset_w @ axes_w[i].T, half_m[i])
        share[block] = np.maximum(share[block], filled)
    blurred = gaussian_filter(share, _BLUR_M / VOXEL_M, mode="nearest")
    return OcclusionGrid(np.ascontiguousarray(blurred.T), low_w)


def _filled_share(shape: int, local_m: NDArray[np.float64], half_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """About how much of the voxel round each local point [..., 3] m the primitive fills."""
    slabs = np.clip((half_m - np.abs(local_m)) / VOXEL_M + 0.5, 0.0, np.minimum(2 * half_m / VOXEL_M, 1.0))
    if shape == BOX:
        return slabs.prod(axis=-1)
    used = 2 if shape == CYLINDER else 3
    radial = np.linalg.norm(local_m[..., :used] / half_m[:used], axis=-1)
    smallest_m = half_m[:used].min()
    inside = np.clip((1 - radial) * smallest_m / VOXEL_M + 0.5, 0.0, min(2 * smallest_m / VOXEL_M, 1.0))
    return inside * slabs[..., 2] if shape == CYLINDER else inside
