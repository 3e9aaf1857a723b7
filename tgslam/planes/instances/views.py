"""The views that a Planar Gaussian Instance is known from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.config.plane_settings import UncertaintySettings
from tgslam.planes.estimate import PlaneEstimate, concatenated, fuse, stacked

Vector = NDArray[np.float64]
Poses = Mapping[int, Vector]  # keyframe -> T_wc [4, 4]

_KEEP_LATEST = 8  # views that thinning does not touch: instances are compared in the latest ones that they share
_LEAST_AREA_M2 = 1e-6  # so that every view has a weight


@dataclass(frozen=True)
class Views:
    """Views in order of their keyframes. They stay in their cameras' frames, whatever becomes of the poses."""

    planes: PlaneEstimate  # [N] each in its keyframe's camera, as certain as the sensor's noise leaves it
    keyframes: NDArray[np.int64]  # [N]
    areas_m2: Vector  # [N]
    rms_m: Vector  # [N] distance of the points from the plane

    @classmethod
    def none(cls) -> Views:
        """Of what no view shows."""
        return cls(stacked([]), np.zeros(0, np.int64), np.zeros(0), np.zeros(0))

    @classmethod
    def one(cls, keyframe: int, plane: PlaneEstimate, area_m2: float, rms_m: float) -> Views:
        """A single one."""
        area = np.array([max(area_m2, _LEAST_AREA_M2)])
        return cls(stacked([plane]), np.array([keyframe]), area, np.array([rms_m]))

    def __len__(self) -> int:
        return len(self.keyframes)

    def __getitem__(self, chosen: Any) -> Views:
        """Some of them."""
        return Views(self.planes[chosen], self.keyframes[chosen], self.areas_m2[chosen], self.rms_m[chosen])

    @property
    def mean_rms_m(self) -> float:
        """Root mean square distance of all points from their planes, weighted by area."""
        return float(np.sqrt(self.areas_m2 @ self.rms_m**2 / self.areas_m2.sum()))

    def joined(self, other: Views, limit: int) -> Views:
        """With those of another one; where that makes more than `limit`, without those with the nearest neighbours."""
        both = Views(
            concatenated(self.planes, other.planes),
            np.concatenate([self.keyframes, other.keyframes]),
            np.concatenate([self.areas_m2, other.areas_m2]),
            np.concatenate([self.rms_m, other.rms_m]),
        )
        return both[_thinned(np.argsort(both.keyframes, kind="stable"), both.keyframes, limit)]

    def of(self, keyframe: int, surface_sigma_m: float) -> PlaneEstimate | None:
        """The plane as that keyframe saw it, in its camera's frame; None where it did not or is no longer known.

        surface_sigma_m: by what the surface strays from its plane.
        """
        seen = slice(*np.searchsorted(self.keyframes, [keyframe, keyframe + 1]).tolist())
        planes = self.planes[seen].with_surface_error(self.areas_m2[seen], surface_sigma_m)
        return fuse(planes) if len(planes.normal) > 1 else planes[0] if len(planes.normal) else None

    def by_keyframe(self, surface_sigma_m: float) -> dict[int, PlaneEstimate]:
        """The plane as each keyframe saw it; see `of`."""
        planes = self.planes.with_surface_error(self.areas_m2, surface_sigma_m)
        keyframes, first, counts = np.unique(self.keyframes, return_index=True, return_counts=True)
        found = zip(keyframes.tolist(), first.tolist(), counts.tolist(), strict=True)
        return {k: planes[i] if count == 1 else fuse(planes[i : i + count]) for k, i, count in found}

    def fused(self, poses: Poses, config: UncertaintySettings) -> tuple[PlaneEstimate, PlaneEstimate]:
        """The plane that all views agree on, at the poses that their keyframes have now, in the world.

        Also the plane of the latest view, without the uncertainty of that view's pose.
        """
        T_wc = self.poses(poses)
        rough = self.planes.with_surface_error(self.areas_m2, config.planarity_sigma_m)
        bent = rough.with_sensor_bias(self.areas_m2, config.bias_per_m2)
        world = bent.with_pose_error(config.pose_sigma_rad, config.pose_sigma_m).transformed(T_wc)
        return fuse(world, config.independent_views), bent[-1].transformed(T_wc[-1])

    def poses(self, poses: Poses) -> Vector:
        """[N, 4, 4] T_wc of their keyframes."""
        return np.stack([poses[int(k)] for k in self.keyframes])


def _thinned(order: NDArray[np.int64], keyframes: NDArray[np.int64], limit: int) -> NDArray[np.int64]:
    """At most `limit` of the indices `order`, which sort the keyframes: first and latest stay, spread stays even."""
    while len(order) > limit:
        sorted_keyframes = keyframes[order]
        inner = sorted_keyframes[2:] - sorted_keyframes[:-2]
        order = np.delete(order, 1 + int(np.argmin(inner[: max(len(inner) - _KEEP_LATEST, 1)])))
    return order
