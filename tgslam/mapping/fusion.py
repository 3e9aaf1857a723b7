"""Depth and normal of mapped Gaussians, averaged over keyframes by information.

Sensor noise grows with z^2, so a surface first seen from afar is known poorly, and the first near view must outweigh
all far ones. Refinement by gradient steps does not weigh views so; this does, once a keyframe, in closed form.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.geometry import matrix_from_quat_wxyz, quat_product_wxyz
from tgslam.ops import image as images

_MAX_OBSERVATIONS = (
    30.0  # information grows to so many of the present view and no further: a map must be able to follow
)
_MAX_TURN_COSINE = 0.5  # normals further apart than 60 degrees are of different surfaces


def depth_pyramid(depth_m: NDArray[np.float32], levels: int) -> list[NDArray[np.float32]]:
    """The depth image [H, W] and its halvings, each mean of a surface's measurements."""
    pyramid = [depth_m]
    for _ in range(levels - 1):
        if min(pyramid[-1].shape) < 2:
            break
        pyramid.append(runtime.to_host(images.halve_depth(runtime.to_device(pyramid[-1]))))
    return pyramid


def sample(
    pyramid: list[NDArray[np.float32]], u: NDArray[np.intp], v: NDArray[np.intp], size_px: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean depth [N] m over a block of at most `size_px` [N] pixels at (u, v), 0 = none, and the block's width in px.

    The mean belongs to `block_centre`.
    """
    level = np.clip(np.floor(np.log2(np.maximum(size_px, 1.0))), 0, len(pyramid) - 1).astype(int)
    depth_m = np.zeros(len(u))
    for k, image in enumerate(pyramid):
        at = level == k
        row = np.minimum(v[at] >> k, image.shape[0] - 1)
        column = np.minimum(u[at] >> k, image.shape[1] - 1)
        depth_m[at] = image[row, column]
    return depth_m, 2.0**level


def block_centre(pixel: NDArray[np.intp], width_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Centre [N] px, along one axis, of the blocks of that width that hold the pixels [N]."""
    return np.floor(pixel / width_px) * width_px + (width_px - 1.0) / 2.0


def fused_depth(
    z: NDArray[np.float64],
    information: NDArray[np.float64],
    measured_m: NDArray[np.float64],
    measured_information: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Kalman update of depths [N] m with their information [N] 1/m^2: new depth, new information, and the gain [N].

    Rows whose measurement holds no information keep what they have, at gain 0.
    """
    measured = measured_information > 0
    gain = measured_information / np.where(measured, information + measured_information, 1.0)
    # Growth is capped, knowledge is not lost: far views after near ones do not wash them out
    growth = np.minimum(information, _MAX_OBSERVATIONS * measured_information) + measured_information
    known = np.where(measured, np.maximum(information, growth), information)
    return z + np.where(measured, gain * (measured_m - z), 0.0), known, np.where(measured, gain, 0.0)


def turned(
    quat_wxyz: NDArray[np.float64], towards: NDArray[np.float64], gain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotate Gaussians so that their third axis moves by `gain` [N] of the way to the unit normals `towards` [N, 3].

    quat_wxyz: [N, 4]. Rows with no normal (zero) or one too far off stay.
    """
    axis = matrix_from_quat_wxyz(quat_wxyz)[:, :, 2]
    facing = np.sum(axis * towards, -1)
    target = np.where(facing[:, None] < 0, -towards, towards)
    near = np.abs(facing) > _MAX_TURN_COSINE
    goal = axis + gain[:, None] * (target - axis)
    goal /= np.maximum(np.linalg.norm(goal, axis=-1, keepdims=True), 1e-12)
    # the shortest rotation from axis to goal: (1 + a . g, a x g), normalised
    turn = np.concatenate([1.0 + np.sum(axis * goal, -1, keepdims=True), np.cross(axis, goal)], -1)
    turn /= np.linalg.norm(turn, axis=-1, keepdims=True)
    return np.where(near[:, None], quat_product_wxyz(turn, quat_wxyz), quat_wxyz)
