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


def _padded(image: NDArray[Any], largest: int) -> NDArray[Any]:
    """The image with zeros at the right and bottom, so that the largest cells tile it."""
    padding = [(0, -image.shape[0] % largest), (0, -image.shape[1] % largest)]
    return np.pad(image, padding + [(0, 0)] * (image.ndim - 2))


def _largest(config: SeedingConfig) -> int:
    return config.smallest_cell_px * 2 ** (config.cell_levels - 1)


def cell_sizes(
    colour: NDArray[np.floating], depth_m: NDArray[np.floating], config: SeedingConfig, sigma_per_m2: float
) -> NDArray[np.int32]:
    """The quadtree of a frame: the size in pixels of the cell at each pixel [H, W], as large as the surface allows."""
    size = _largest(config)
    depth, rgb = _padded(depth_m.astype(np.float64), size), _padded(colour.astype(np.float64), size)
    sizes = np.full(depth.shape, config.smallest_cell_px, np.int32)
    while size > config.smallest_cell_px:
        cells = _is_plain_and_planar(rgb, depth, size, config, sigma_per_m2)
        whole = np.repeat(np.repeat(cells, size, 0), size, 1)
        sizes = np.where(whole & (sizes < size), size, sizes)
        size //= 2
    return sizes[: depth_m.shape[0], : depth_m.shape[1]]


def quadtree(
    colour: NDArray[np.floating],
    depth_m: NDArray[np.floating],
    wanted: NDArray[np.bool_],
    config: SeedingConfig,
    sigma_per_m2: float,
) -> Cells:
    """Cells that cover the `wanted` pixels [H, W] with depth, from the largest size down to `smallest_cell_px`.

    A cell that is wanted only in part is split; of the smallest ones, those are used that are wanted in half or more of
    their pixels with depth.
    """
    size = _largest(config)
    desired = _padded(cell_sizes(colour, depth_m, config, sigma_per_m2), size)
    depth, rgb = _padded(depth_m.astype(np.float64), size), _padded(colour.astype(np.float64), size)
    need = _padded(wanted & (depth_m > 0), size)
    open_cells = np.ones((depth.shape[0] // size, depth.shape[1] // size), bool)
    found = []
    while True:
        valid = _blocks(depth, size) > 0
        count, needed = valid.sum(-1), _blocks(need, size).sum(-1)
        if size > config.smallest_cell_px:
            use = open_cells & (desired[::size, ::size] >= size) & (needed == count) & (count > 0)
        else:
            use = open_cells & (2 * needed >= count) & (count > 0)
        found.append(_means(use, valid[use], depth, rgb, size))
        if size <= config.smallest_cell_px:
            break
        open_cells = np.repeat(np.repeat(open_cells & ~use, 2, 0), 2, 1)
        size //= 2
    return Cells(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _means(
    use: NDArray[np.bool_], valid: NDArray[np.bool_], depth: NDArray[np.floating], rgb: NDArray[np.floating], size: int
) -> tuple[NDArray[np.float64], ...]:
    """The columns of `Cells` for the blocks [rows, columns] in `use`, from their valid pixels [N, size * size]."""
    row, column = np.nonzero(use)
    weight = valid / valid.sum(-1, keepdims=True)
    within_y, within_x = np.divmod(np.arange(size * size), size)
    inverse_z = weight / np.where(valid, _blocks(depth, size)[use], 1.0)  # a plane's mean depth is that of the centre
    return (
        column * size + weight @ within_x,
        row * size + weight @ within_y,
        np.full(len(row), float(size)),
        1.0 / inverse_z.sum(-1),
        np.einsum("np,npc->nc", weight, _blocks(rgb, size)[use]),
    )


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
