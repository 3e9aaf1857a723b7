"""Pixels that lie on a PGI where it is known to be, although the view's own segments say nothing of it, or another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import SensorNoise
from tgslam.config.plane_settings import PlanesConfig
from tgslam.geometry import inverse
from tgslam.planes.instances.instance import NO_ID, PlanarInstance

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
        noise: SensorNoise,
    ) -> None:
        """instances: the PGIs by id. depth_m: [H, W] m. rays: [H, W, 3] camera frame, z = 1."""
        self._instances, self._config, self._noise = instances, config, noise
        self._depth_m, self._rays, self._T_cw, self._T_wc = depth_m, rays, T_cw, inverse(T_cw)

    def completed(self, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        """ids [H, W] where pixels of no PGI have that one on whose extent they lie, to the sensor's accuracy.

        A view leaves out what is small, far or at a bad angle; other views know it, and it still is no empty space.
        """
        pixels, points = self._measured(ids == NO_ID)
        least = np.full(len(pixels), self._config.expert.association.gate_sigmas**2)
        found = np.full(len(pixels), NO_ID, np.int32)
        for instance in self._in_view():
            squares = self._squared_sigmas(instance, points)
            near = np.flatnonzero(squares < least)
            near = near[instance.support.shows_extent(points[:, near], self._T_wc)]
            least[near], found[near] = squares[near], instance.id
        result = ids.copy()
        result.ravel()[pixels] = found
        return result

    def divided(self, ids: NDArray[np.int32], plane_id: int, others: Sequence[PlanarInstance]) -> NDArray[np.int32]:
        """ids [H, W] where those pixels of one PGI that lie on the extent of others, but not on its own, are theirs.

        From afar a view takes for one surface what nearer views have parted.
        """
        pixels, points = self._measured(ids == plane_id)
        beyond = ~self._instances[plane_id].support.shows_extent(points, self._T_wc)
        pixels, points = pixels[beyond], points[:, beyond]
        result = ids.copy()
        for other in others:
            result.ravel()[pixels[other.support.shows_extent(points, self._T_wc)]] = other.id
        return result

    def _in_view(self) -> list[PlanarInstance]:
        instances = list(self._instances.values())
        if not instances:
            return []
        normals = np.stack([instance.normal_w for instance in instances])
        offsets = np.array([instance.offset_m for instance in instances])
        front = normals @ self._T_wc[:3, 3] + offsets > 0
        return [instance for instance, seen in zip(instances, front, strict=True) if seen]

    def _measured(self, chosen: NDArray[np.bool_]) -> tuple[NDArray[np.intp], Points]:
        """The pixels [N] with depth out of those chosen [H, W], counted row by row; their points [3, N] m, camera."""
        pixels = np.flatnonzero(chosen & (self._depth_m > 0))
        z = self._depth_m.ravel()[pixels]
        return pixels, np.ascontiguousarray((self._rays.reshape(-1, 3)[pixels] * z[:, None]).T)

    def _squared_sigmas(self, instance: PlanarInstance, points: Points) -> Points:
        """[N] by how many standard deviations of what the sensor measures points [3, N] m lie off a plane, squared."""
        normal = self._T_cw[:3, :3] @ instance.normal_w
        offset_m = instance.offset_m + float(instance.normal_w @ self._T_wc[:3, 3])
        along = normal[0] * points[0] + normal[1] * points[1] + normal[2] * points[2]
        sigma_m = self._noise.per_m2 * points[2] * along
        result: Points = (along + offset_m) ** 2 / (sigma_m**2 + self._config.expert.uncertainty.planarity_sigma_m**2)
        return result
