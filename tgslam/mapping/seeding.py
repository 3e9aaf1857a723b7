"""Gaussians from one RGB-D frame: large flat ones where a quadtree cell is plain and planar, small ones elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.config.schema import SeedingConfig
from tgslam.geometry import inverse, quat_wxyz_from_matrices, transform_points
from tgslam.types import Camera, Gaussians

_MIN_COSINE = 0.25  # foreshortening is compensated up to here: beyond, a cell's Gaussian would become a needle


@dataclass(frozen=True)
class Cells:
    """Quadtree leaves of a frame: a square of `size_px` pixels each, with the mean of its valid pixels."""

    u: NDArray[np.float64]  # [N] px, centre
    v: NDArray[np.float64]  # [N] px
    size_px: NDArray[np.float64]  # [N]
    depth_m: NDArray[np.float64]  # [N]
    colour: NDArray[np.float64]  # [N, 3]


def _blocks(image: NDArray[Any], size: int) -> NDArray[Any]:
    """[H, W, ...] -> [H // size, W // size, size * size, ...]; the remainder at the right and bottom is cut off."""
    rows, columns = image.shape[0] // size, image.shape[1] // size
    cut = image[: rows * size, : columns * size]
    split = cut.reshape(rows, size, columns, size, *image.shape[2:]).swapaxes(1, 2)
    return split.reshape(rows, columns, size * size, *image.shape[2:])


def _is_plain_and_planar(
    colour: NDArray[np.floating], depth_m: NDArray[np.floating], size: int, config: SeedingConfig, sigma_per_m2: float
) -> NDArray[np.bool_]:
    """[rows, columns] cells in which every pixel has depth, colours hardly vary and one plane explains the depth.

    A plane's inverse depth is affine in the pixel, so the fit is linear and on a regular grid closed-form.
    """
    z = _blocks(depth_m, size)
    grey = _blocks(colour, size)
    complete = (z > 0).all(-1)
    plain = grey.std(2).max(-1) < config.plain_colour_std
    inverse_z = 1.0 / np.where(z > 0, z, 1.0)
    offset = np.arange(size) - (size - 1) / 2
    y, x = (axis.reshape(-1) for axis in np.meshgrid(offset, offset, indexing="ij"))
    norm = (x * x).sum()
    mean = inverse_z.mean(-1)
    fit = mean[..., None] + (inverse_z @ x / norm)[..., None] * x + (inverse_z @ y / norm)[..., None] * y
    residual_rms = np.sqrt(((inverse_z - fit) ** 2).mean(-1))  # in 1/m, where the sensor's noise is uniform
    return complete & plain & (residual_rms < config.planar_sigmas * sigma_per_m2)


def quadtree(
    colour: NDArray[np.floating],
    depth_m: NDArray[np.floating],
    wanted: NDArray[np.bool_],
    config: SeedingConfig,
    sigma_per_m2: float,
) -> Cells:
    """Cells that cover the `wanted` pixels [H, W] with depth, from the largest size down to `smallest_cell_px`.

    A cell counts as wanted if at least half of its pixels with depth are.
    """
    found: list[list[NDArray[np.floating]]] = []
    size = config.smallest_cell_px * 2 ** (config.cell_levels - 1)
    open_cells = np.ones((-(-depth_m.shape[0] // size), -(-depth_m.shape[1] // size)), bool)
    padding = [(0, -depth_m.shape[0] % size), (0, -depth_m.shape[1] % size)]
    depth = np.pad(depth_m.astype(np.float64), padding)
    rgb = np.pad(colour.astype(np.float64), [*padding, (0, 0)])
    need = np.pad(wanted, padding)
    while True:
        valid = _blocks(depth, size) > 0
        count = valid.sum(-1)
        smallest = size <= config.smallest_cell_px
        leaf = open_cells & (count > 0)
        if not smallest:
            leaf &= _is_plain_and_planar(rgb, depth, size, config, sigma_per_m2)
        use = leaf & (2 * (_blocks(need, size) & valid).sum(-1) >= np.maximum(count, 1))
        row, column = np.nonzero(use)
        weight = valid[use] / count[use][:, None]
        centre = (size - 1) / 2
        within_y, within_x = np.divmod(np.arange(size * size), size)
        found.append([
            column * size + (weight @ within_x if smallest else np.full(len(column), centre)),
            row * size + (weight @ within_y if smallest else np.full(len(row), centre)),
            np.full(len(row), float(size)),
            1.0 / (weight / np.where(valid[use], _blocks(depth, size)[use], 1.0)).sum(-1),
            np.einsum("np,npc->nc", weight, _blocks(rgb, size)[use]),
        ])  # fmt: skip
        if smallest:
            break
        open_cells = np.repeat(np.repeat(open_cells & ~leaf, 2, 0), 2, 1)
        size //= 2
    return Cells(*(np.concatenate(column) for column in zip(*found, strict=True)))


def seed(
    cells: Cells,
    normals: NDArray[np.floating],
    camera: Camera,
    T_cw: NDArray[np.float64],
    keyframe: int,
    config: SeedingConfig,
) -> Gaussians:
    """One flat Gaussian a cell, in the world frame: aligned with the surface, as wide as the cell's footprint.

    normals: [H, W, 3] in the camera frame towards the camera, 0 = unknown (then the viewing direction is used).
    """
    n = len(cells.u)
    ray = np.stack([(cells.u - camera.cx) / camera.fx, (cells.v - camera.cy) / camera.fy, np.ones(n)], -1)
    towards = -ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    normal = normals[np.rint(cells.v).astype(int), np.rint(cells.u).astype(int)].astype(np.float64)
    known = (normal * towards).sum(-1) > 0.05
    normal = np.where(known[:, None], normal, towards)
    cosine = np.maximum((normal * towards).sum(-1), _MIN_COSINE)
    # Axes: across the slope (not foreshortened), along the slope, normal
    across = np.cross(normal, towards)
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    helper = np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    across = np.where(
        length > 1e-3, across / np.maximum(length, 1e-12), helper / np.linalg.norm(helper, axis=-1, keepdims=True)
    )
    along = np.cross(normal, across)
    footprint = config.overlap * cells.size_px * cells.depth_m / camera.fx
    scale = np.stack([footprint, footprint / cosine, config.thickness * footprint], -1)
    T_wc = inverse(T_cw)
    axes = T_wc[:3, :3] @ np.stack([across, along, normal], -1)
    return Gaussians(
        mean=transform_points(T_wc, ray * cells.depth_m[:, None]).astype(np.float32),
        log_scale=np.log(scale).astype(np.float32),
        quat_wxyz=quat_wxyz_from_matrices(axes).astype(np.float32),
        opacity_logit=np.full(n, np.log(config.opacity / (1.0 - config.opacity)), np.float32),
        colour=cells.colour.astype(np.float32),
        embedding=np.zeros((n, 3), np.float32),
        plane_id=np.full(n, -1, np.int32),
        birth_keyframe=np.full(n, keyframe, np.int32),
    )
