"""Gaussians from one RGB-D frame: large flat ones where a quadtree cell is plain and planar, small ones elsewhere."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.map_settings import SeedingConfig
from tgslam.device import runtime
from tgslam.geometry import inverse, quat_wxyz_from_matrices, transform_points
from tgslam.ops import seeding
from tgslam.types import Gaussians

_MIN_COSINE = 0.25  # foreshortening is compensated up to here: beyond, a cell's Gaussian would become a needle
_STEP = 0.03  # share of the depth by which measurements of two surfaces are apart, if also by more than noise
_STEP_SIGMAS = 4.2  # three sigma of a difference


@dataclass(frozen=True)
class Cells:
    """Quadtree leaves of a frame: a square of `size_px` pixels each, with the mean of its pixels on one surface."""

    u: NDArray[np.float64]  # [N] px, centre
    v: NDArray[np.float64]  # [N] px
    size_px: NDArray[np.float64]  # [N]
    depth_m: NDArray[np.float64]  # [N]
    colour: NDArray[np.float64]  # [N, 3]


def cell_sizes(
    colour: NDArray[np.floating],
    depth_m: NDArray[np.floating],
    config: SeedingConfig,
    noise: SensorNoise,
    plane_ids: NDArray[np.int32] | None = None,
) -> NDArray[np.int32]:
    """The quadtree of a frame: the size in pixels of the cell at each of its smallest cells, [rows, columns].

    It is as large as the surface allows: a larger one is plain and planar (`ops.seeding`). Rows and columns are
    those of the frame with zeros at the right and bottom, so that the largest cells tile it. plane_ids: [H, W] PGI of
    each pixel, -1 = none; on one of them cells may be larger still, and the colour need only be plain but for a trend.
    """
    whole = _whole_cells(colour, depth_m, config, noise, plane_ids)
    sizes = np.full(whole[0].shape, config.smallest_cell_px, np.int32)
    for level in range(1, len(whole)):
        sizes[_spread(whole[level], 1 << level) > 0] = config.smallest_cell_px << level
    return sizes


def cell_levels(config: SeedingConfig, width_px: int, *, on_planes: bool = False) -> int:
    """Sizes of cells in an image of that width, each twice the one before: what counts is the angle that they cover."""
    across = config.largest_cells_across
    if on_planes:
        across = min(across, config.largest_plane_cells_across)
    return 1 + max(round(math.log2(width_px / across / config.smallest_cell_px)), 0)


def _whole_cells(
    colour: NDArray[np.floating],
    depth_m: NDArray[np.floating],
    config: SeedingConfig,
    noise: SensorNoise,
    plane_ids: NDArray[np.int32] | None,
) -> list[NDArray[np.int32]]:
    """By level [rows, columns] of `ops.seeding`: the cells that one Gaussian can stand for, or that lie in such."""
    flatness, device = config.expert.flatness, (runtime.to_device(colour), runtime.to_device(depth_m))
    plain_levels = cell_levels(config, depth_m.shape[1])
    levels = plain_levels if plane_ids is None else cell_levels(config, depth_m.shape[1], on_planes=True)
    rows, columns = _tiles(depth_m, config, levels)
    ids = np.full(depth_m.shape, -1, np.int32) if plane_ids is None else plane_ids
    device_ids = runtime.to_device(ids, np.int32)
    whole = [np.zeros((rows, columns), np.int32)]
    for level in range(1, levels):
        cells = seeding.plain_and_planar(
            *device,
            device_ids,
            (rows >> level, columns >> level),
            config.smallest_cell_px << level,
            plain_std=flatness.plain_colour_std,
            plane_std=flatness.plane_colour_std,
            planar_rms=flatness.planar_sigmas * noise.per_m2,
            on_planes_only=level >= plain_levels,
        )
        whole.append(cells)
    for level in range(plain_levels, levels):
        whole[level] *= _graded(whole[level - 1])
    for level in reversed(range(1, levels - 1)):
        whole[level] = np.maximum(whole[level], _spread(whole[level + 1], 2))
    return whole


def _graded(smaller: NDArray[np.int32]) -> NDArray[np.int32]:
    """[rows, columns] 1 where a cell, given the next smaller ones, has only whole ones of those inside and around.

    A Gaussian reaches a cell's width beyond its cell. Were large cells to touch edges, walls would run on beyond their
    corners, by which the tracker goes wrong.
    """
    rows, columns = smaller.shape[0] // 2, smaller.shape[1] // 2
    whole = (smaller > 0).reshape(rows, 2, columns, 2).all((1, 3)).astype(np.uint8)
    return cv2.erode(whole, np.ones((3, 3), np.uint8), borderValue=1).astype(np.int32)


def _spread(cells: NDArray[np.int32], step: int) -> NDArray[np.int32]:
    """Every cell step x step times."""
    return np.repeat(np.repeat(cells, step, 0), step, 1)


def quadtree(
    colour: NDArray[np.floating],
    depth_m: NDArray[np.floating],
    wanted: NDArray[np.bool_],
    config: SeedingConfig,
    noise: SensorNoise,
    plane_ids: NDArray[np.int32] | None = None,
) -> Cells:
    """Cells that cover the `wanted` pixels [H, W] with depth, from the largest size down to `smallest_cell_px`.

    A cell that is wanted only in part is split; of the smallest ones, those are used that are wanted in half or more of
    their pixels with depth. plane_ids: as for `cell_sizes`. On a plane, where Gaussians may overlap without harm, cells
    of every size are used that are wanted in half or more, and nothing smaller than the second size.
    """
    whole = _whole_cells(colour, depth_m, config, noise, plane_ids)
    shape = (whole[0].shape[0] * config.smallest_cell_px, whole[0].shape[1] * config.smallest_cell_px)
    depth, rgb = _padded(depth_m, shape), _padded(colour, shape)
    valid = depth > 0
    counts = _pyramid_of_counts(valid, config, len(whole))
    needs = _pyramid_of_counts(valid & _padded(wanted, shape), config, len(whole))
    open_cells = np.ones(counts[-1].shape, bool)
    found = []
    for level in reversed(range(len(whole))):
        count, needed, size = counts[level], needs[level], config.smallest_cell_px << level
        mostly = (2 * needed >= count) & (count > 0)
        on_plane = whole[level] == seeding.ON_PLANE
        if level:
            use = open_cells & mostly & (on_plane | ((whole[level] > 0) & (needed == count)))
        else:
            use = open_cells & mostly
        found.append(_means(use, depth, rgb, size, None if level else noise))  # larger ones are planar
        if level:
            crumbs = on_plane & ~mostly if level == 1 else np.zeros(use.shape, bool)
            open_cells = np.repeat(np.repeat(open_cells & ~use & ~crumbs, 2, 0), 2, 1)
    return Cells(*(np.concatenate(column) for column in zip(*found, strict=True)))


def _tiles(image: NDArray[Any], config: SeedingConfig, levels: int) -> tuple[int, int]:
    """Rows and columns of smallest cells that the largest cells over an image [H, W] hold."""
    split = 1 << (levels - 1)
    largest = config.smallest_cell_px * split
    return -(-image.shape[0] // largest) * split, -(-image.shape[1] // largest) * split


def _padded(image: NDArray[Any], shape: tuple[int, int]) -> NDArray[Any]:
    """The image with zeros at the right and bottom."""
    padding = [(0, wide - have) for wide, have in zip(shape, image.shape, strict=False)]
    if not any(added for _, added in padding):
        return image
    return np.pad(image, padding + [(0, 0)] * (image.ndim - 2))


def _pyramid_of_counts(mask: NDArray[np.bool_], config: SeedingConfig, levels: int) -> list[NDArray[np.int32]]:
    """How many pixels of each cell are set, from the smallest cells up."""
    counts = [_block_sums(mask, config.smallest_cell_px)]
    for _ in range(1, levels):
        counts.append(_block_sums(counts[-1], 2))
    return counts


def _block_sums(image: NDArray[Any], size: int) -> NDArray[np.int32]:
    """Sums over blocks of size x size."""
    total = np.zeros((image.shape[0] // size, image.shape[1] // size), np.int32)
    for dy in range(size):
        for dx in range(size):
            total += image[dy::size, dx::size]
    return total


def _means(
    use: NDArray[np.bool_],
    depth: NDArray[np.floating],
    rgb: NDArray[np.floating],
    size: int,
    noise: SensorNoise | None,
) -> tuple[NDArray[np.float64], ...]:
    """The columns of `Cells` for the blocks [rows, columns] in `use`, from their pixels with depth.

    noise: the sensor's, by which to tell pixels on one surface from others; None = all are on one.
    """
    row, column = np.nonzero(use)
    within_y, within_x = np.divmod(np.arange(size * size), size)
    at = row[:, None] * size + within_y, column[:, None] * size + within_x
    z, colours = depth[at].astype(np.float64), rgb[at].astype(np.float64)
    inverse_z = 1.0 / np.where(z > 0, z, np.inf)
    alike = inverse_z > 0 if noise is None else _on_one_surface(inverse_z, noise)
    weight = alike / alike.sum(-1, keepdims=True)
    return (
        column * size + weight @ within_x,
        row * size + weight @ within_y,
        np.full(len(row), float(size)),
        1.0 / (weight * inverse_z).sum(-1),  # a plane's mean depth is that of the centre
        np.einsum("np,npc->nc", weight, colours),
    )


def _on_one_surface(inverse_z: NDArray[np.float64], noise: SensorNoise) -> NDArray[np.bool_]:
    """Which pixels [N, P] of a cell show the surface that most of them show, the nearer one of two that are even.

    The mean of two surfaces would hang in the air between them. inverse_z: [N, P] 1/m, 0 = no depth, at least one > 0 a
    cell; its noise is the same at every depth.
    """
    ordered = np.sort(inverse_z, -1)  # no depth first, then from far to near
    known = (inverse_z > 0).sum(-1)
    median = np.take_along_axis(ordered, (inverse_z.shape[1] - known + known // 2)[:, None], -1)
    tolerance = np.maximum(_STEP * median, _STEP_SIGMAS * noise.per_m2)
    alike: NDArray[np.bool_] = (inverse_z > 0) & (np.abs(inverse_z - median) <= tolerance)
    return alike


def seed(
    cells: Cells,
    normals: NDArray[np.floating],
    camera: Camera,
    T_cw: NDArray[np.float64],
    keyframe: int,
    config: SeedingConfig,
    plane_ids: NDArray[np.int32] | None = None,
) -> Gaussians:
    """One flat Gaussian a cell, in the world frame: aligned with the surface, as wide as the cell's footprint.

    normals: [H, W, 3] in the camera frame towards the camera, 0 = unknown (then the viewing direction is used).
    plane_ids: [H, W] PGI of each pixel, -1 = none. Embeddings are neutral.
    """
    n = len(cells.u)
    row, column = np.rint(cells.v).astype(int), np.rint(cells.u).astype(int)
    ids = np.full(n, -1, np.int32) if plane_ids is None else plane_ids[row, column]
    ray = camera.rays_at(cells.u, cells.v)
    towards = -ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    normal = normals[row, column].astype(np.float64)
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
    shape = config.expert.gaussians
    footprint = shape.overlap * cells.size_px * cells.depth_m / camera.fx
    scale = np.stack([footprint, footprint / cosine, shape.thickness * footprint], -1)
    T_wc = inverse(T_cw)
    axes = T_wc[:3, :3] @ np.stack([across, along, normal], -1)
    return Gaussians(
        mean=transform_points(T_wc, ray * cells.depth_m[:, None]).astype(np.float32),
        log_scale=np.log(scale).astype(np.float32),
        quat_wxyz=quat_wxyz_from_matrices(axes).astype(np.float32),
        opacity_logit=np.full(n, np.log(shape.seed_opacity / (1.0 - shape.seed_opacity)), np.float32),
        colour=cells.colour.astype(np.float32),
        embedding=np.zeros((n, 3), np.float32),
        plane_id=ids.astype(np.int32),
        birth_keyframe=np.full(n, keyframe, np.int32),
    )
