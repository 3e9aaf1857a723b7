"""Pixels that lie on a PGI where it is known to be, although the view's own segments say nothing of it, or another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam.config.schema import PlanesConfig
from tgslam.geometry import inverse, transform_points
from tgslam.planes.instance import NO_ID, PlanarInstance

Points = NDArray[np.float64]


class KnownExtents:
    """A keyframe's measured pixels held against the extents of the PGIs."""

    def __init__(
        self,
        instances: Mapping[int, PlanarInstance],
        depth_m: NDArray[np.float32],
        rays: Points,
        T_cw: NDArray[np.float64],
        config: PlanesConfig,
        sigma_per_m2: float,
    ) -> None:
        """instances: the PGIs by id. depth_m: [H, W] m. rays: [H, W, 3] camera frame, z = 1."""
        self._instances, self._config, self._sigma_per_m2 = instances, config, sigma_per_m2
        self._depth_m, self._rays, self._T_cw = depth_m, rays, T_cw

    def completed(self, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        """ids [H, W] where pixels of no PGI have that one on whose extent they lie, to the sensor's accuracy.

        A view leaves out what is small, far or at a bad angle; other views know it, and it still is no empty space.
        """
        rows, columns = np.nonzero((ids == NO_ID) & (self._depth_m > 0))
        points = self._points_w(rows, columns)
        least = np.full(len(rows), np.inf)
        found = np.full(len(rows), NO_ID, np.int32)
        for instance in self._in_view():
            sigmas = np.abs(instance.plane.heights_m(points)) / self._height_sigma_m(instance, rows, columns)
            near = np.flatnonzero((sigmas <= self._config.gate_sigmas) & (sigmas < least))
            near = near[instance.support.holds(instance.support.cells_of(points[near]))]
            least[near], found[near] = sigmas[near], instance.id
        result = ids.copy()
        result[rows, columns] = found
        return result

    def divided(self, ids: NDArray[np.int32], plane_id: int, others: Sequence[PlanarInstance]) -> NDArray[np.int32]:
        """ids [H, W] where those pixels of one PGI that lie on the extent of others, but not on its own, are theirs.

        From afar a view takes for one surface what nearer views have parted.
        """
        own = self._instances[plane_id].support
        rows, columns = np.nonzero((ids == plane_id) & (self._depth_m > 0))
        points = self._points_w(rows, columns)
        beyond = ~own.holds(own.cells_of(points))
        result = ids.copy()
        for other in others:
            theirs = beyond & other.support.holds(other.support.cells_of(points))
            result[rows[theirs], columns[theirs]] = other.id
        return result

    def _in_view(self) -> list[PlanarInstance]:
        instances = list(self._instances.values())
        if not instances:
            return []
        normals = np.stack([instance.normal_w for instance in instances])
        offsets = np.array([instance.offset_m for instance in instances])
        front = normals @ inverse(self._T_cw)[:3, 3] + offsets > 0
        return [instance for instance, seen in zip(instances, front, strict=True) if seen]

    def _points_w(self, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> Points:
        return transform_points(
            inverse(self._T_cw), self._rays[rows, columns] * self._depth_m[rows, columns, None].astype(np.float64)
        )

    def _height_sigma_m(
        self, instance: PlanarInstance, rows: NDArray[np.intp], columns: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """[N] of what the sensor measures at pixels, over a plane."""
        facing = self._rays[rows, columns] @ (self._T_cw[:3, :3] @ instance.normal_w)
        sigma_m = self._sigma_per_m2 * self._depth_m[rows, columns].astype(np.float64) ** 2 * facing
        result: NDArray[np.float64] = np.hypot(sigma_m, self._config.model_sigma_m)
        return result
