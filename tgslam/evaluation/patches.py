"""Patches of surface that a frame measures: cubes of the world, each with the face that the surface in it is turned to.

The two sides of a thin wall are two patches. A patch bears the id that nearly all of its pixels show, if they show one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.evaluation.panoptic import IdImage
from tgslam.geometry import rotate_rows
from tgslam.types import FloatImage, Matrix4

_CUBE_M = 0.1  # what is narrower is not judged; smaller cubes would be lost in the noise of far surfaces
_FEWEST_PX = 4  # of a patch in a frame
_AGREEING = 0.8  # of its pixels, for an id to be the patch's: those at the border of two planes have none
_FLATNESS = 1.5  # times the variance along the normal that a patch has across it at least
_LEAST_SPREAD_M = 0.005  # standard deviation across, likewise
_LEAST_FACING = 0.15  # cosine of the most grazing angle at which a patch is judged
_AXIS_BITS = 19  # of a cube's index along an axis: 52 km

_Values = NDArray[np.float64]
_Indices = NDArray[np.intp]


@dataclass(frozen=True)
class Patches:
    """What a frame shows, patch by patch, in ascending order of their keys."""

    keys: NDArray[np.int64]  # [P] the same patch has the same key in every frame
    ids: NDArray[np.int32]  # [P] that nearly all pixels show
    pixels: NDArray[np.int64]  # [P]
    areas_m2: _Values  # [P] of the surface that those pixels show


@dataclass(frozen=True)
class _Runs:
    """Pixels that follow each other in one cube and show one id: sums by cube go through them, since they are few."""

    cube: _Indices  # [R] that a run lies in, each of the G cubes once at least
    length: _Indices  # [R] pixels

    def of(self, kept: NDArray[np.bool_]) -> tuple[_Indices, _Runs]:
        """Which of the pixels [N] lie in the cubes kept [G], and their runs."""
        inside = kept[self.cube]
        renumbered = np.cumsum(kept) - 1
        return np.flatnonzero(np.repeat(inside, self.length)), _Runs(renumbered[self.cube[inside]], self.length[inside])

    def sums(self, values: _Values) -> _Values:
        """[G] by cube, of the pixels' values [N]."""
        return np.bincount(self.cube, np.add.reduceat(values, self._starts())).astype(np.float64)

    def any_of(self, values: _Values) -> _Values:
        """[G] the value of some pixel in each cube, of values [N]."""
        return values[self._starts()[np.unique(self.cube, return_index=True)[1]]]

    def spread(self, values: _Values) -> _Values:
        """[N] by pixel, values [G] of the cubes."""
        return np.repeat(values[self.cube], self.length)

    def _starts(self) -> _Indices:
        return np.cumsum(self.length) - self.length


def patches_of(depth_m: FloatImage, ids: IdImage, camera: Camera, T_wc: Matrix4) -> Patches:
    """The patches of a frame that bear an id and face the camera well enough to tell how."""
    measured = np.flatnonzero(depth_m > 0)
    z = depth_m.ravel()[measured].astype(np.float64)
    rays = rotate_rows(T_wc[:3, :3], _rays(camera).take(measured, axis=1))
    points = rays * z + T_wc[:3, 3:]
    corners = np.floor(points / _CUBE_M)
    runs, cube, count, borne = _cubes(corners.astype(np.int64), ids.ravel()[measured])
    kept = (count >= _FEWEST_PX) & (borne >= 0)
    at, runs = runs.of(kept)  # the work that follows is on those that may be patches
    cube, count, borne, z, rays = cube[kept], count[kept], borne[kept], z[at], rays.take(at, axis=1)
    normals = _normals(points.take(at, axis=1), corners.take(at, axis=1) * _CUBE_M, runs, count, T_wc[:3, 3])
    nx, ny, nz = (runs.spread(normals[:, i]) for i in range(3))
    cosine = np.abs(nx * rays[0] + ny * rays[1] + nz * rays[2])  # with a ray as long as z = 1 asks for
    facing = runs.sums(cosine) / count
    area_m2 = runs.sums(z**2 / (camera.fx * camera.fy)) / np.maximum(facing, _LEAST_FACING)
    axis = np.argmax(np.abs(normals), axis=1)
    face = 2 * axis + (normals[np.arange(len(cube)), axis] > 0)
    told = facing >= _LEAST_FACING
    # In order of the cubes, each of which has one normal in a frame, the keys are in order too
    return Patches(((cube << 3) | face)[told], borne[told], count[told], area_m2[told])


@lru_cache(maxsize=1)
def _rays(camera: Camera) -> _Values:
    """[3, H W] as `Camera.rays`."""
    return np.ascontiguousarray(camera.rays().reshape(-1, 3).T)


def _cubes(
    corners: NDArray[np.int64], ids: NDArray[np.int32]
) -> tuple[_Runs, NDArray[np.int64], NDArray[np.int64], NDArray[np.int32]]:
    """The runs of pixels [N] whose cubes are at corners [3, N]; keys [G] of the cubes, ascending, pixels, and ids."""
    x, y, z = corners + (1 << _AXIS_BITS - 1)
    packed = (x << 2 * _AXIS_BITS) | (y << _AXIS_BITS) | z
    first = np.diff(packed, prepend=-1) != 0
    first[1:] |= ids[1:] != ids[:-1]
    start = np.flatnonzero(first)
    cube, of = np.unique(packed[start], return_inverse=True)
    runs = _Runs(of.reshape(-1), np.diff(start, append=len(ids)))
    count = np.bincount(runs.cube, runs.length, len(cube)).astype(np.int64)
    return runs, cube, count, _agreed(ids[start], runs, count)


def _agreed(ids: NDArray[np.int32], runs: _Runs, count: NDArray[np.int64]) -> NDArray[np.int32]:
    """[G] the id that nearly all pixels [G] of each cube show; -1 = none. ids: [R] of the runs."""
    result, borne = np.full(len(count), -1, np.int32), ids >= 0
    span = np.int64(ids.max(initial=0)) + 1
    pairs, of = np.unique(runs.cube[borne] * span + ids[borne], return_inverse=True)
    cube, known = np.divmod(pairs, span)
    agreed = np.bincount(of.reshape(-1), runs.length[borne], len(pairs)) / count[cube] >= _AGREEING
    result[cube[agreed]] = known[agreed]
    return result


def _normals(points: _Values, corners: _Values, runs: _Runs, count: NDArray[np.int64], position: _Values) -> _Values:
    """[G, 3] unit normals of the points [3, N] of each cube, along which they scatter least, turned to `position` [3].

    Cubes whose points scatter as little in another direction, as points on a line do, have none: 0.
    corners: [3, N] of the points' cubes. Sums are taken from them on, so that those of squares are exact.
    """
    local = points - corners
    centre = np.stack([runs.sums(row) / count for row in local], axis=-1)
    scatter = np.empty((len(count), 3, 3))
    for i in range(3):
        for j in range(i + 1):
            moment = runs.sums(local[i] * local[j]) / count - centre[:, i] * centre[:, j]
            scatter[:, i, j] = scatter[:, j, i] = moment
    spread, axes = np.linalg.eigh(scatter)
    normals = axes[..., 0] * (spread[:, 1:2] >= np.maximum(_FLATNESS * spread[:, :1], _LEAST_SPREAD_M**2))
    centre += np.stack([runs.any_of(row) for row in corners], axis=-1)
    away = np.sum(normals * (position - centre), axis=-1, keepdims=True) < 0
    return np.where(away, -normals, normals)
