"""Cells of a frame's quadtree: large where it is plain and planar, small elsewhere. A Gaussian is seeded in each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import SensorNoise
from tgslam.config.map_settings import SeedingConfig
from tgslam.device import runtime
from tgslam.ops import seeding

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


class Quadtree:
    """The cells of a frame, found once: for seeding, and for how large Gaussians may be where they are kept."""

    def __init__(
        self,
        colour: NDArray[np.floating],
        depth_m: NDArray[np.floating],
        config: SeedingConfig,
        noise: SensorNoise,
        plane_ids: NDArray[np.int32] | None = None,
    ) -> None:
        """colour: [H, W, 3] in [0, 1]. depth_m: [H, W], 0 = none. plane_ids: [H, W] PGI of each pixel, -1 = none.

        On a PGI cells may be larger still, and the colour need only be plain but for a trend.
        """
        self._colour, self._depth_m, self._noise = colour, depth_m, noise
        self._smallest_px = config.smallest_cell_px
        self._whole = _whole_cells(colour, depth_m, config, noise, plane_ids)

    def sizes(self, sound: NDArray[np.bool_]) -> NDArray[np.int32]:
        """Size in pixels of the cell at each of the smallest cells, [rows, columns].

        It is as large as the surface allows: a larger one is plain and planar (`ops.seeding`), and all of its pixels
        [H, W] are `sound`. Rows and columns are those of the frame with zeros at the right and bottom, so that the
        largest cells tile it.
        """
        sizes = np.full(self._whole[0].shape, self._smallest_px, np.int32)
        counts = _pyramid_of_counts(_padded(sound, self._padded_shape), self._smallest_px, len(self._whole))
        for level in range(1, len(self._whole)):
            size = self._smallest_px << level
            use = (self._whole[level] > 0) & (counts[level] == size * size)
            sizes[_spread(use, 1 << level)] = size
        return sizes

    @property
    def _padded_shape(self) -> tuple[int, int]:
        rows, columns = self._whole[0].shape
        return rows * self._smallest_px, columns * self._smallest_px

    def leaves(self, wanted: NDArray[np.bool_]) -> Cells:
        """Cells that cover the `wanted` pixels [H, W] with depth, from the largest size down to the smallest.

        A cell that is wanted only in part is split; of the smallest ones, those are used that are wanted in half or
        more of their pixels with depth. On a plane, where Gaussians may overlap without harm, cells of every size are
        used that are wanted in half or more, and nothing smaller than the second size.
        """
        whole, smallest = self._whole, self._smallest_px
        shape = self._padded_shape
        depth, rgb = _padded(self._depth_m, shape), _padded(self._colour, shape)
        valid = depth > 0
        counts = _pyramid_of_counts(valid, smallest, len(whole))
        needs = _pyramid_of_counts(valid & _padded(wanted, shape), smallest, len(whole))
        open_cells = np.ones(counts[-1].shape, bool)
        found = []
        for level in reversed(range(len(whole))):
            count, needed, size = counts[level], needs[level], smallest << level
            mostly = (2 * needed >= count) & (count > 0)
            on_plane = whole[level] == seeding.ON_PLANE
            if level:
                use = open_cells & mostly & (on_plane | ((whole[level] > 0) & (needed == count)))
            else:
                use = open_cells & mostly
            found.append(_means(use, depth, rgb, size, None if level else self._noise))  # larger ones are planar
            if level:
                crumbs = on_plane & ~mostly if level == 1 else np.zeros(use.shape, bool)
                open_cells = np.repeat(np.repeat(open_cells & ~use & ~crumbs, 2, 0), 2, 1)
        return Cells(*(np.concatenate(column) for column in zip(*found, strict=True)))


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


def _spread(cells: NDArray[Any], step: int) -> NDArray[Any]:
    """Every cell step x step times."""
    return np.repeat(np.repeat(cells, step, 0), step, 1)


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


def _pyramid_of_counts(mask: NDArray[np.bool_], smallest_px: int, levels: int) -> list[NDArray[np.int32]]:
    """How many pixels of each cell are set, from the smallest cells up."""
    counts = [_block_sums(mask, smallest_px)]
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
