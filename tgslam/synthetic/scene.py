"""Scenes as arrays: convex primitives, their materials and the planes that they lie on. World frame: z up, metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tgslam.kernels.raycast import BOX, CYLINDER, ELLIPSOID, QUAD
from tgslam.synthetic.occlusion import OcclusionGrid, bake, unoccluded

Vector = NDArray[np.float64]
Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """A procedural surface; `kind` is one of tgslam.kernels.procedural's, which says how the rest is used."""

    kind: int
    colour: Rgb
    second: Rgb = (0.9, 0.9, 0.9)
    scale_s_m: float = 1.0  # size of the pattern along the surface's first axis
    scale_t_m: float = 1.0
    contrast: float = 0.0
    seed: int = 0
    edge_shade: float = 0.0  # darkening at the edges of flat faces, in [0, 1]


@dataclass(frozen=True)
class Lighting:
    """Static light: ambient, a distant fill and a lamp with their strengths."""

    ambient: float = 0.55
    fill: float = 0.25
    fill_direction_w: tuple[float, float, float] = (0.3, -0.5, 0.4)
    lamp: float = 0.35
    lamp_position_w: tuple[float, float, float] = (0.0, 0.0, 2.4)  # m


@dataclass(frozen=True)
class Scene:
    """The geometry of a scene, one row a primitive. See kernels/raycast.py for the shapes and their local frames."""

    meta: NDArray[np.int32]  # [N, 4] shape, material, first plane label, layer
    axes_w: Vector  # [N, 3, 3] rows are the local axes, world
    centre_w: Vector  # [N, 3] m
    half_m: Vector  # [N, 3] m
    radius_m: Vector  # [N] of the bounding sphere
    material_kind: NDArray[np.int32]  # [M, 2] kind, seed
    material: NDArray[np.float32]  # [M, 10] see kernels.raycast.shade
    planes_w: Vector  # [P, 4] unit normal out of the solid, offset in m: n . x + d = 0
    lighting: Lighting
    occlusion: OcclusionGrid

    def __len__(self) -> int:
        return len(self.meta)


def yaw_rotation(yaw_rad: float) -> Vector:
    """Rotation [3, 3] about the world's z axis."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass
class SceneBuilder:
    """Collects primitives; `build` gives the scene. Positions are in m, world, unless said otherwise."""

    lighting: Lighting = field(default_factory=Lighting)
    _materials: list[Material] = field(default_factory=list)
    _rows: list[tuple[tuple[int, int, int, int], Vector, Vector, Vector]] = field(default_factory=list)
    _planes: list[Vector] = field(default_factory=list)

    def quad(
        self,
        centre: ArrayLike,
        along_s: ArrayLike,
        along_t: ArrayLike,
        size: tuple[float, float],
        material: Material,
        painted_on: int | None = None,
        layer: int = 1,
    ) -> int:
        """A rectangle of `size` (s, t) m with unit axes `along_s`, `along_t`; it faces along their cross product.

        painted_on: label of the plane that it is a picture on; then it is exactly coplanar and adds no
        plane. A picture of a higher layer hides one of a lower layer.
        Returns its plane label.
        """
        s, t = np.asarray(along_s, np.float64), np.asarray(along_t, np.float64)
        axes = np.stack([s, t, np.cross(s, t)])
        position = np.array(centre, np.float64)
        if painted_on is not None:
            plane = self._planes[painted_on]
            position -= (plane[:3] @ position + plane[3]) * plane[:3]
        label = self._plane(axes[2], position) if painted_on is None else painted_on
        half = np.array([size[0] / 2, size[1] / 2, 0.0])
        self._add(QUAD, material, label, 0 if painted_on is None else layer, axes, position, half)
        return label

    def box(self, centre: ArrayLike, size: Sequence[float], material: Material, yaw_rad: float = 0.0) -> int:
        """A box of `size` (x, y, z) m turned about z. Returns its first label of six: -x, +x, -y, +y, -z, +z."""
        axes = yaw_rotation(yaw_rad).T
        position, half = np.asarray(centre, np.float64), np.asarray(size, np.float64) / 2
        first = len(self._planes)
        for axis in range(3):
            for sign in (-1.0, 1.0):
                self._plane(sign * axes[axis], position + sign * half[axis] * axes[axis])
        self._add(BOX, material, first, 0, axes, position, half)
        return first

    def ellipsoid(self, centre: ArrayLike, radii: Sequence[float], material: Material, yaw_rad: float = 0.0) -> None:
        """An ellipsoid of `radii` m: it lies on no plane."""
        axes, position = yaw_rotation(yaw_rad).T, np.asarray(centre, np.float64)
        self._add(ELLIPSOID, material, -1, 0, axes, position, np.asarray(radii, np.float64))

    def cylinder(self, base: ArrayLike, radius: float, height: float, material: Material, axis: int = 2) -> int:
        """A round cylinder from `base` along world axis `axis` (0, 1, 2). Returns its first of two cap labels."""
        axes = np.roll(np.eye(3), 2 - axis, axis=0)
        bottom = np.asarray(base, np.float64)
        first = self._plane(-axes[2], bottom)
        self._plane(axes[2], bottom + height * axes[2])
        half = np.array([radius, radius, height / 2])
        self._add(CYLINDER, material, first, 0, axes, bottom + height / 2 * axes[2], half)
        return first

    def build(self, occlusion: bool = True) -> Scene:
        """The scene of everything added so far. occlusion: bake it, which takes memory by the scene's volume."""
        metas, axes, centres, halves = zip(*self._rows, strict=True)
        meta, half_m = np.array(metas, np.int32), np.array(halves)
        radius_m = np.where(meta[:, 0] == ELLIPSOID, half_m.max(axis=1), np.linalg.norm(half_m, axis=1))
        solids = (meta[:, 0], np.array(axes), np.array(centres), half_m, radius_m)
        return Scene(
            meta=meta,
            axes_w=solids[1],
            centre_w=solids[2],
            half_m=half_m,
            radius_m=radius_m,
            material_kind=np.array([(m.kind, m.seed) for m in self._materials], np.int32),
            material=np.array(
                [(*m.colour, *m.second, m.scale_s_m, m.scale_t_m, m.contrast, m.edge_shade) for m in self._materials],
                np.float32,
            ),
            planes_w=np.array(self._planes).reshape(-1, 4),
            lighting=self.lighting,
            occlusion=bake(*solids) if occlusion else unoccluded(),
        )

    def _plane(self, normal: Vector, point: Vector) -> int:
        self._planes.append(np.append(normal, -normal @ point))
        return len(self._planes) - 1

    def _add(
        self, shape: int, material: Material, label: int, layer: int, axes: Vector, centre: Vector, half: Vector
    ) -> None:
        if material not in self._materials:
            self._materials.append(material)
        meta = (shape, self._materials.index(material), label, layer)
        self._rows.append((meta, axes, centre, half))
