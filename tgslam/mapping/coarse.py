"""Gaussians that are too large for the camera that comes near them: seeded anew in its image, split at its rim."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tgslam.geometry import matrix_from_quat_wxyz
from tgslam.map.gaussians import GaussianMap
from tgslam.mapping.surface import Surface
from tgslam.types import Gaussians

_REACH = 2.0  # standard deviations to which a Gaussian is seen
_ROUNDS = 4  # of halving, at most


def seen_whole(gaussians: GaussianMap, surface: Surface, limit_px: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[N] Gaussians on the keyframe's surface that are larger in its image than limit_px [H, W] and well inside it.

    They were seeded from afar or, on floors and walls, at a grazing angle. The keyframe can fill all that they leave.
    """
    std_px = _longest(surface.axes_px(gaussians, np.flatnonzero(surface.ahead)), surface)
    large = std_px > limit_px[surface.nearest_pixel]
    return surface.supported & large & surface.inside_by(_REACH * std_px)


def seen_in_part(gaussians: GaussianMap, surface: Surface, steepest: float) -> NDArray[np.bool_]:
    """[N] Gaussians that reach into the image from beyond its rim and whose depth differs too much within them.

    A splat knows no perspective: one on a wall beside the camera, whose centre is out of view and whose standard
    deviation in depth is more than `steepest` times its depth, shows a wrong picture in a wrong place. It cannot be
    seeded anew by a keyframe that does not see all of it.
    """
    ahead = np.flatnonzero(surface.ahead)
    std_px = _longest(surface.axes_px(gaussians, ahead), surface)
    steep = _longest(surface.axes_depth(gaussians, ahead), surface) > steepest
    return surface.not_hidden & steep & surface.inside_by(-_REACH * std_px) & ~surface.inside_by(_REACH * std_px)


def halved(
    gaussians: GaussianMap, rows: NDArray[np.intp], surface: Surface, steepest: float, cell_stds: float
) -> tuple[Gaussians, NDArray[np.intp]]:
    """The parts of these rows that are not too steep any more, and for each the row that it comes from.

    A Gaussian stands for a cell of `cell_stds` standard deviations. Its halves stand for the halves of that, divided
    where it is deepest, as often as it takes.
    """
    depths = surface.axes_depth(gaussians, rows)
    axes = matrix_from_quat_wxyz(gaussians.host("quat_wxyz")[rows].astype(np.float64))
    mean = gaussians.host("mean")[rows].astype(np.float64)
    log_scale = gaussians.host("log_scale")[rows].astype(np.float64)
    of = np.arange(len(rows))
    for _ in range(_ROUNDS):
        axis = depths.argmax(axis=1)
        deep = np.flatnonzero(depths.max(axis=1) > steepest)
        across = axis[deep]
        step = axes[of[deep], :, across] * (np.exp(log_scale[deep, across]) * cell_stds / 4.0)[:, None]
        log_scale[deep, across] -= np.log(2.0)
        depths[deep, across] /= 2.0
        mean = np.concatenate([mean, mean[deep] + step])
        mean[deep] -= step
        log_scale, depths, of = (np.concatenate([a, a[deep]]) for a in (log_scale, depths, of))
    order = np.argsort(of, kind="stable")
    parents = rows[of[order]]
    parts = gaussians.rows(parents)
    return replace(parts, mean=mean[order].astype(np.float32), log_scale=log_scale[order].astype(np.float32)), parents


def _longest(by_axis: NDArray[np.float64], surface: Surface) -> NDArray[np.float64]:
    """[N] the largest of the three values [ahead, 3] of each; 0 for what is not ahead."""
    longest = np.zeros(len(surface.z))
    longest[surface.ahead] = by_axis.max(axis=1)
    return longest
