"""Planes in a keyframe: segmented, matched to the PGIs, and told to keyframes and Gaussians (sections 3.2, 3.3)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.plane_settings import PlanesConfig
from tgslam.device import runtime
from tgslam.map.gaussians import GaussianMap
from tgslam.map.keyframes import Keyframe
from tgslam.map.plane_labels import NO_PLANE
from tgslam.map.world import Map
from tgslam.mapping.extents import KnownExtents
from tgslam.mapping.planar_pixels import PlanarPixels
from tgslam.mapping.surface import Projection
from tgslam.planes.instances.registry import PlaneRegistry
from tgslam.planes.segmentation.extraction import extract_planes

_CLOSING_PX = 7  # window in which a PGI may surround a pixel
_CLOSING_SHARE = 0.6  # of its pixels that must be the PGI's
_GLANCE_PX = 4  # between the pixels that tell whether a keyframe shows a plane at all
_AGREEMENT = 5.0  # standard deviations of sensor and model between a PGI and a measurement that counts as its


class PlaneObserver:
    """Looks for the planes of each new keyframe, and keeps what all keyframes show of the PGIs up to date."""

    def __init__(self, camera: Camera, config: PlanesConfig, noise: SensorNoise) -> None:
        self._camera, self._config, self._noise = camera, config, noise
        self._rays = camera.rays()

    def observe(self, world: Map) -> PlanarPixels:
        """Match the latest keyframe's planes to the PGIs; it and earlier ones show what comes of that."""
        registry, number = _registry_of(world), len(world.keyframes) - 1
        keyframe, depth_m = world.keyframes[number], world.keyframes[number].depth_m()
        view = extract_planes(runtime.to_device(depth_m), self._camera, self._config, self._noise)
        view = registry.with_known_steps(view, depth_m, self._camera, keyframe.T_cw)
        observation = registry.observe(view, depth_m, self._camera, keyframe.T_cw, number)
        for earlier in world.keyframes[:-1]:
            self._correct(registry, earlier, observation.corrected)
            self._show_new(registry, earlier, observation.created)
        seen = observation.id_image(view.labels)
        ids = self._completed(registry, self._closed(seen), depth_m, keyframe.T_cw)
        pixels = self._pixels(registry, ids, depth_m, keyframe.T_cw)
        # Surfaces that wait for other views are no part of those that they may lie close to: they are named later
        waiting = (view.labels >= 0) & (seen == NO_PLANE)
        keyframe.show(np.where(waiting, NO_PLANE, pixels.ids))
        return pixels

    def label(self, world: Map, pixels: PlanarPixels) -> None:
        """Tie the Gaussians in the latest keyframe's image to the PGIs that its pixels name, where they lie on them.

        All others follow merges, and let go of PGIs that are no more.
        """
        registry, gaussians = _registry_of(world), world.gaussians
        seen = Projection(gaussians, self._camera, world.keyframes[-1].T_cw)
        rows, ids = np.flatnonzero(seen.inside), pixels.ids[seen.v, seen.u]
        plane_ids = registry.table.resolved(gaussians.host("plane_id"))
        means = gaussians.host("mean")
        for plane_id, instance in registry.instances.items():
            named = rows[ids == plane_id]
            distance = np.abs(means[named] @ instance.normal_w + instance.offset_m)
            plane_ids[named[distance < self._config.expert.association.max_distance_m]] = plane_id
        _write_ids(gaussians, plane_ids)

    def complete(self, world: Map) -> None:
        """Keyframes show PGIs that were confirmed, or seen in full, only after them."""
        registry = _registry_of(world)
        for keyframe in world.keyframes:
            keyframe.show(self._completed(registry, _shown(keyframe), keyframe.depth_m(), keyframe.T_cw))

    def _correct(self, registry: PlaneRegistry, keyframe: Keyframe, plane_ids: Sequence[int]) -> None:
        """A keyframe shows PGIs, parts of which have turned out to be other ones."""
        assert keyframe.labels is not None
        shown = [plane_id for plane_id in plane_ids if keyframe.labels.pixels(plane_id)]
        if shown:
            extents = self._extents(registry, keyframe.depth_m(), keyframe.T_cw)
            keyframe.show(_divided(registry, _shown(keyframe), shown, extents))

    def _show_new(self, registry: PlaneRegistry, keyframe: Keyframe, plane_ids: Sequence[int]) -> None:
        """A keyframe may show PGIs that only later ones have confirmed."""
        instances = registry.instances
        new = {i: instances[i] for i in plane_ids if i in instances}
        if not new:
            return
        depth_m, ids = keyframe.depth_m(), _shown(keyframe)
        for step in (_GLANCE_PX, 1):  # most keyframes do not show them, which few pixels tell
            part = np.s_[::step, ::step]
            extents = KnownExtents(new, depth_m[part], self._rays[part], keyframe.T_cw, self._config, self._noise)
            completed = extents.completed(ids[part])
            if np.array_equal(completed, ids[part]):
                return
        keyframe.show(completed)

    def _completed(
        self,
        registry: PlaneRegistry,
        ids: NDArray[np.int32],
        depth_m: NDArray[np.float32],
        T_cw: NDArray[np.float64],
    ) -> NDArray[np.int32]:
        """What the view's segments say, corrected by what is known of the PGIs from other views."""
        extents = self._extents(registry, depth_m, T_cw)
        return extents.completed(_divided(registry, ids, _named(ids).tolist(), extents))

    def _extents(
        self, registry: PlaneRegistry, depth_m: NDArray[np.float32], T_cw: NDArray[np.float64]
    ) -> KnownExtents:
        return KnownExtents(registry.instances, depth_m, self._rays, T_cw, self._config, self._noise)

    def _pixels(
        self,
        registry: PlaneRegistry,
        ids: NDArray[np.int32],
        measured_m: NDArray[np.float32],
        T_cw: NDArray[np.float64],
    ) -> PlanarPixels:
        """Depth and normals of the PGIs, where they agree with the measurement."""
        depth_m = np.zeros(ids.shape, np.float32)
        normals_c = np.zeros((*ids.shape, 3), np.float32)
        kept = np.full(ids.shape, NO_PLANE, np.int32)
        instances = registry.instances
        for plane_id in _named(ids).tolist():
            if plane_id not in instances:
                continue
            at = np.flatnonzero(ids == plane_id)
            instance, measured = instances[plane_id], measured_m.ravel()[at]
            normal = T_cw[:3, :3] @ instance.normal_w
            offset_m = instance.offset_m - normal @ T_cw[:3, 3]
            z = -offset_m / np.minimum(self._rays.reshape(-1, 3)[at] @ normal, -1e-6)
            agrees = np.abs(z - measured) < _AGREEMENT * (
                self._noise.sigma_m(z) + self._config.expert.uncertainty.planarity_sigma_m
            )
            agrees |= measured <= 0
            on = at[agrees]
            depth_m.ravel()[on], kept.ravel()[on] = z[agrees], plane_id
            normals_c.reshape(-1, 3)[on] = normal
        return PlanarPixels(kept, depth_m, normals_c)

    def _closed(self, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        """Pixels that one PGI surrounds belong to it: holes and outliers of the sensor."""
        known = _named(ids)
        number = np.zeros(int(known.max(initial=NO_PLANE)) + 2, np.uint8)
        number[known + 1] = np.arange(1, len(known) + 1)
        index = number[ids + 1]
        square = np.ones((_CLOSING_PX, _CLOSING_PX), np.uint8)
        highest = cv2.dilate(index, square)
        lowest = cv2.erode(np.where(index > 0, index, np.uint8(255)), square, borderValue=255)
        share = cv2.blur((index > 0).astype(np.float32), square.shape)
        fill = (index == 0) & (highest == lowest) & (share > _CLOSING_SHARE)
        filled: NDArray[np.int32] = ids.copy()
        filled[fill] = known[highest[fill] - 1]
        return filled


def _registry_of(world: Map) -> PlaneRegistry:
    assert world.planes is not None  # planes are observed only where the map knows of them
    return world.planes


def _shown(keyframe: Keyframe) -> NDArray[np.int32]:
    """[H, W] the PGI of each pixel, by the ids that they had when the keyframe was told."""
    assert keyframe.labels is not None
    return keyframe.labels.image()


def _divided(
    registry: PlaneRegistry, ids: NDArray[np.int32], plane_ids: Sequence[int], extents: KnownExtents
) -> NDArray[np.int32]:
    for plane_id in plane_ids:
        if others := registry.parted_from(plane_id):
            ids = extents.divided(ids, plane_id, others)
    return ids


def _write_ids(gaussians: GaussianMap, plane_ids: NDArray[np.int32]) -> None:
    gaussians.write("plane_id", slice(0, gaussians.count), plane_ids)


def _named(ids: NDArray[np.int32]) -> NDArray[np.intp]:
    """The PGIs, ascending, that an image of ids [H, W] names."""
    return np.flatnonzero(np.bincount(ids.ravel() + 1)[1:])
