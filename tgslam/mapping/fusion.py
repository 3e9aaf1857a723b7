"""Depth and normal of mapped Gaussians, averaged over keyframes by information.

Sensor noise grows with z^2, so a surface first seen from afar is known poorly, and the first near view must outweigh
all far ones. Refinement by gradient steps does not weigh views so; this does, once a keyframe, in closed form.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.map_settings import SeedingConfig
from tgslam.device import runtime
from tgslam.geometry import inverse, matrix_from_quat_wxyz, quat_product_wxyz
from tgslam.map.world import Map
from tgslam.mapping.carriers import CarrierDraw
from tgslam.mapping.quadtree import cell_levels
from tgslam.mapping.surface import Surface
from tgslam.ops import image as images

# Information grows to so many of the present view and no further: a map must be able to follow
_MAX_OBSERVATIONS = 30.0
_MAX_TURN_COSINE = 0.5  # normals further apart than 60 degrees are of different surfaces
_MIN_COSINE = 0.1  # a surface more grazing than this says nothing of the depth beside
_MAX_SLANT = 0.1  # nor one whose depth changes by more within a block


class DepthFusion:
    """Averages a keyframe's depth and normals into the Gaussians that it supports."""

    def __init__(
        self, camera: Camera, noise: SensorNoise, seeding: SeedingConfig, limit_sigmas: float, draw: CarrierDraw
    ) -> None:
        """limit_sigmas: a measurement farther off, in standard deviations of the sensor, is of another surface."""
        self._camera, self._noise, self._limit_sigmas, self._draw = camera, noise, limit_sigmas, draw
        self._overlap, self._levels = seeding.expert.gaussians.overlap, cell_levels(seeding, camera.width)

    def fuse(self, world: Map, surface: Surface, kept: NDArray[np.bool_]) -> None:
        """Take in the latest keyframe. surface: how the first N Gaussians stand to it; kept: [N] those to be moved."""
        use = surface.supported & kept
        rows = np.flatnonzero(use)
        if not len(rows):
            return
        gaussians, images_, T_cw = world.gaussians, world.keyframes.latest_images, world.keyframes[-1].T_cw
        at = use[surface.inside]
        u, v, z = surface.u[at], surface.v[at], surface.z[use]
        means, scales = gaussians.host("mean"), gaussians.host("log_scale")
        width_px = np.exp(np.sort(scales[rows], -1)[:, 1]) * self._camera.fx / (z * self._overlap)
        measured, block_px = sample(depth_pyramid(images_.depth_m, self._levels + 1), u, v, width_px)
        rotations = gaussians.host("quat_wxyz")[rows].astype(np.float64)
        normals_c = matrix_from_quat_wxyz(rotations)[:, :, 2] @ T_cw[:3, :3].T
        centres = block_centre(u, block_px), block_centre(v, block_px)
        measured *= self._slant(normals_c, centres, (surface.exact_u[use], surface.exact_v[use]))
        sigma_m = self._noise.sigma_m(z)
        agrees = (measured > 0) & (np.abs(measured - z) < self._limit_sigmas * sigma_m)
        evidence = np.where(agrees, block_px**2 / sigma_m**2, 0.0)
        fused, information, gain = fused_depth(z, gaussians.host("information")[rows], measured, evidence)
        gaussians.write("information", rows, information)
        gaussians.write("carriers", rows, self._draw(gaussians.host("carriers")[rows], len(world.keyframes) - 1, gain))
        T_wc = inverse(T_cw)
        towards = images_.normals[v, u].astype(np.float64) @ T_wc[:3, :3].T
        gaussians.write("mean", rows, T_wc[:3, 3] + (fused / z)[:, None] * (means[rows] - T_wc[:3, 3]))
        gaussians.write("quat_wxyz", rows, turned(rotations, towards, gain))

    def _slant(
        self,
        normals_c: NDArray[np.float64],
        seen_at: tuple[NDArray[np.float64], NDArray[np.float64]],
        wanted_at: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """Depth at one pixel over depth at another [N], on planes with those normals [N, 3]; 1 where it is unclear."""
        seen, wanted = (np.sum(normals_c * self._camera.rays_at(u, v), -1) for u, v in (seen_at, wanted_at))
        ratio = seen / np.where(np.abs(wanted) > _MIN_COSINE, wanted, np.inf)
        return np.where(np.abs(ratio - 1.0) < _MAX_SLANT, ratio, 1.0)


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
