"""Planes in mapping: what the Planar Gaussian Instances say of a keyframe's pixels and of the map's Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.plane_settings import PlanesConfig
from tgslam.device import runtime
from tgslam.geometry import inverse
from tgslam.map.gaussians import GaussianMap
from tgslam.map.keyframe import Keyframe
from tgslam.mapping.extents import KnownExtents
from tgslam.mapping.surface import Projection
from tgslam.planes.instances.instance import NO_ID, PlanarInstance
from tgslam.planes.instances.plane_table import PlaneTable
from tgslam.planes.instances.registry import PlaneRegistry
from tgslam.planes.segmentation.extraction import extract_planes
from tgslam.tracking.reference import NO_PLANES

_MAX_SLANT = 0.1  # of its depth by which a plane's changes at most where it continues into a hole
_CLOSING_PX = 7  # window in which a PGI may surround a pixel
_CLOSING_SHARE = 0.6  # of its pixels that must be the PGI's
_GLANCE_PX = 4  # between the pixels that tell whether a keyframe shows a plane at all
_AGREEMENT = 5.0  # standard deviations of sensor and model between a PGI and a measurement that counts as its

# Of the pixels' normals, that planes give the camera in each direction at least: measured normals are off by 0.1 to 0.2
# rad, so that noise alone gives 1 to 3 %
_HELD = 0.05


@dataclass(frozen=True)
class PlanarPixels:
    """The PGIs in a keyframe's image."""

    ids: NDArray[np.int32]  # [H, W] -1 = on no PGI
    depth_m: NDArray[np.float32]  # [H, W] of the PGI along the pixel's ray; 0 where there is none
    normals_c: NDArray[np.float32]  # [H, W, 3] of the PGI, towards the camera; 0 where there is none

    def continued(self, source: NDArray[np.int64], rays: NDArray[np.floating]) -> PlanarPixels:
        """With the planes of PGIs where guesses take the depth of their pixels; they are on no PGI all the same, since
        nothing has measured it there.

        source: [H, W] as of `depth.Guess`. rays: [H, W, 3] camera frame, z = 1.
        """
        known, directions = self.depth_m.ravel(), rays.reshape(-1, 3)
        at = np.flatnonzero((self.depth_m.ravel() <= 0) & (source.ravel() >= 0))
        at = at[known[source.ravel()[at]] > 0]
        of = source.ravel()[at]
        normals = self.normals_c.reshape(-1, 3)[of].astype(np.float64)
        there, here = (np.sum(normals * directions[pixels], -1) for pixels in (of, at))
        ratio = there / np.minimum(here, -1e-6)
        level = np.abs(ratio - 1.0) < _MAX_SLANT
        depth_m, normals_c = self.depth_m.copy(), self.normals_c.copy()
        depth_m.ravel()[at[level]] = (ratio * known[of])[level]
        normals_c.reshape(-1, 3)[at[level]] = normals[level]
        return PlanarPixels(self.ids, depth_m, normals_c)


class PlanarMapping:
    """Finds planes in keyframes, keeps the PGIs, and ties Gaussians to them."""

    def __init__(self, camera: Camera, config: PlanesConfig, sigma_per_m2: float) -> None:
        """sigma_per_m2: the sensor's noise, sigma_z = this * z^2."""
        self.camera, self.config, self.sigma_per_m2 = camera, config, sigma_per_m2
        self.noise = SensorNoise(sigma_per_m2)
        self._T_wc: dict[int, NDArray[np.float64]] = {}  # of each keyframe, as the PGIs know it
        self.registry = PlaneRegistry(config, self.noise, self._T_wc)
        self._T_cw: list[NDArray[np.float64]] = []  # likewise
        self._rays = camera.rays()

    @property
    def instances(self) -> dict[int, PlanarInstance]:
        """The PGIs by id."""
        return self.registry.instances

    def observe(self, keyframes: Sequence[Keyframe]) -> PlanarPixels:
        """Match the last keyframe's planes to the PGIs, which first follow the others where refinement has moved them.

        keyframes: all of the run so far, one more at each call.
        """
        self.follow(keyframes)
        keyframe, number = keyframes[-1], len(keyframes) - 1
        self._T_cw.append(keyframe.T_cw.copy())
        self._T_wc[number] = inverse(keyframe.T_cw)
        depth_m = keyframe.depth_m()
        view = extract_planes(runtime.to_device(depth_m), self.camera, self.config, self.noise)
        view = self.registry.with_known_steps(view, depth_m, self.camera, keyframe.T_cw)
        observation = self.registry.observe(view, depth_m, self.camera, keyframe.T_cw, number)
        for earlier in keyframes[:-1]:
            self._correct(earlier, observation.corrected)
            self._show_new(earlier, observation.created)
        seen = observation.id_image(view.labels)
        ids = self._completed(self._closed(seen), depth_m, keyframe.T_cw)
        pixels = self._pixels(ids, depth_m, keyframe.T_cw)
        # Surfaces that wait for other views are no part of those that they may lie close to: they are named later
        waiting = (view.labels >= 0) & (seen == NO_ID)
        keyframe.plane_ids = np.where(waiting, NO_ID, pixels.ids).astype(np.int32)
        return pixels

    def table(self) -> PlaneTable:
        """The planes as they are now, by every id that was ever given."""
        return self.registry.table

    def seen_from(self, number: int) -> list[PlanarInstance]:
        """The PGIs that a keyframe saw."""
        return [self.instances[i] for i in self.registry.seen_from(number)]

    def steadying(self, number: int, keyframe: Keyframe) -> NDArray[np.float64]:
        """[P, 4] n . x + d = 0 in a keyframe's camera: the PGIs whose normals its surfaces take in tracking.

        Those are all that it saw, if together they leave a direction free, along which noise of measured normals would
        hold the camera; else none, since measured normals follow what real surfaces stray from planes by. number: the
        keyframe's.
        """
        if self._least_held(keyframe) >= _HELD:
            return NO_PLANES
        planes_w = np.array([(*plane.normal_w, plane.offset_m) for plane in self.seen_from(number)]).reshape(-1, 4)
        return planes_w @ inverse(keyframe.T_cw)

    def _least_held(self, keyframe: Keyframe) -> float:
        """Share of a keyframe's depth whose normals point in the direction in which the fewest do.

        What is on no plane is taken to face all directions alike.
        """
        assert keyframe.plane_ids is not None
        normals = self.table().planes_w[:, :3]
        pixels = np.bincount(keyframe.plane_ids[keyframe.plane_ids >= 0], minlength=len(normals)) * normals.any(axis=1)
        measured = max(int(np.count_nonzero(keyframe.depth_m())), 1)
        others = max(measured - int(pixels.sum()), 0)
        moments = np.einsum("n,ni,nj->ij", pixels, normals, normals)
        return (float(np.linalg.eigvalsh(moments)[0]) + others / 3.0) / measured

    def label(self, gaussians: GaussianMap, T_cw: NDArray[np.float64], pixels: PlanarPixels) -> None:
        """Tie the Gaussians in a keyframe's image to the PGIs that its pixels name, where they lie on them.

        All others follow merges, and let go of PGIs that are no more.
        """
        seen = Projection(gaussians, self.camera, T_cw)
        rows, ids = np.flatnonzero(seen.inside), pixels.ids[seen.v, seen.u]
        plane_ids = self.table().resolved(gaussians.host("plane_id"))
        means = gaussians.host("mean")
        for plane_id, instance in self.instances.items():
            named = rows[ids == plane_id]
            distance = np.abs(means[named] @ instance.normal_w + instance.offset_m)
            plane_ids[named[distance < self.config.max_distance_m]] = plane_id
        gaussians.write("plane_id", slice(0, gaussians.count), plane_ids)

    def follow(self, keyframes: Sequence[Keyframe]) -> None:
        """Move the PGIs with the keyframes that saw them."""
        corrections = {}
        for number, known in enumerate(self._T_cw):
            T_cw = keyframes[number].T_cw
            if not np.array_equal(T_cw, known):
                corrections[number] = inverse(T_cw) @ known
                self._T_wc[number] = corrections[number] @ self._T_wc[number]
                self._T_cw[number] = T_cw.copy()
        if corrections:
            self.registry.follow(corrections)

    def complete(self, keyframes: Sequence[Keyframe]) -> None:
        """Keyframes show PGIs that were confirmed, or seen in full, only after them."""
        for keyframe in keyframes:
            assert keyframe.plane_ids is not None
            _show(keyframe, self._completed(keyframe.plane_ids.astype(np.int32), keyframe.depth_m(), keyframe.T_cw))

    def _correct(self, keyframe: Keyframe, plane_ids: Sequence[int]) -> None:
        """A keyframe shows PGIs, parts of which have turned out to be other ones."""
        assert keyframe.plane_ids is not None
        shown = [plane_id for plane_id in plane_ids if (keyframe.plane_ids == plane_id).any()]
        if shown:
            extents = self._extents(keyframe.depth_m(), keyframe.T_cw)
            _show(keyframe, self._divided(keyframe.plane_ids.astype(np.int32), shown, extents))

    def _show_new(self, keyframe: Keyframe, plane_ids: Sequence[int]) -> None:
        """A keyframe may show PGIs that only later ones have confirmed."""
        assert keyframe.plane_ids is not None
        new = {i: self.instances[i] for i in plane_ids if i in self.instances}
        if not new:
            return
        depth_m, ids = keyframe.depth_m(), keyframe.plane_ids.astype(np.int32)
        for step in (_GLANCE_PX, 1):  # most keyframes do not show them, which few pixels tell
            part = np.s_[::step, ::step]
            extents = KnownExtents(new, depth_m[part], self._rays[part], keyframe.T_cw, self.config, self.sigma_per_m2)
            completed = extents.completed(ids[part])
            if np.array_equal(completed, ids[part]):
                return
        keyframe.plane_ids = completed.astype(np.int32)

    def _completed(
        self, ids: NDArray[np.int32], depth_m: NDArray[np.float32], T_cw: NDArray[np.float64]
    ) -> NDArray[np.int32]:
        """What the view's segments say, corrected by what is known of the PGIs from other views."""
        extents = self._extents(depth_m, T_cw)
        return extents.completed(self._divided(ids, _named(ids).tolist(), extents))

    def _divided(self, ids: NDArray[np.int32], plane_ids: Sequence[int], extents: KnownExtents) -> NDArray[np.int32]:
        for plane_id in plane_ids:
            if others := self.registry.parted_from(plane_id):
                ids = extents.divided(ids, plane_id, others)
        return ids

    def _extents(self, depth_m: NDArray[np.float32], T_cw: NDArray[np.float64]) -> KnownExtents:
        return KnownExtents(self.instances, depth_m, self._rays, T_cw, self.config, self.sigma_per_m2)

    def _pixels(
        self, ids: NDArray[np.int32], measured_m: NDArray[np.float32], T_cw: NDArray[np.float64]
    ) -> PlanarPixels:
        """Depth and normals of the PGIs, where they agree with the measurement."""
        depth_m = np.zeros(ids.shape, np.float32)
        normals_c = np.zeros((*ids.shape, 3), np.float32)
        kept = np.full(ids.shape, NO_ID, np.int32)
        instances = self.instances
        for plane_id in _named(ids).tolist():
            if plane_id not in instances:
                continue
            at = np.flatnonzero(ids == plane_id)
            instance, measured = instances[plane_id], measured_m.ravel()[at]
            normal = T_cw[:3, :3] @ instance.normal_w
            offset_m = instance.offset_m - normal @ T_cw[:3, 3]
            z = -offset_m / np.minimum(self._rays.reshape(-1, 3)[at] @ normal, -1e-6)
            sigma_m = self.sigma_per_m2 * z**2
            agrees = np.abs(z - measured) < _AGREEMENT * (sigma_m + self.config.expert.uncertainty.planarity_sigma_m)
            agrees |= measured <= 0
            on = at[agrees]
            depth_m.ravel()[on], kept.ravel()[on] = z[agrees], plane_id
            normals_c.reshape(-1, 3)[on] = normal
        return PlanarPixels(kept, depth_m, normals_c)

    def _closed(self, ids: NDArray[np.int32]) -> NDArray[np.int32]:
        """Pixels that one PGI surrounds belong to it: holes and outliers of the sensor."""
        known = _named(ids)
        number = np.zeros(int(known.max(initial=NO_ID)) + 2, np.uint8)
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


def _show(keyframe: Keyframe, ids: NDArray[np.int32]) -> None:
    """Tell a keyframe its PGIs [H, W]. Its array stays if nothing is new, and with it what was prepared from that."""
    assert keyframe.plane_ids is not None
    if not np.array_equal(ids, keyframe.plane_ids):
        keyframe.plane_ids = ids.astype(np.int32)


def _named(ids: NDArray[np.int32]) -> NDArray[np.intp]:
    """The PGIs, ascending, that an image of ids [H, W] names."""
    return np.flatnonzero(np.bincount(ids.ravel() + 1)[1:])
