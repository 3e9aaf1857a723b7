"""A Planar Gaussian Instance (PGI): a plane of the world that persists, and the views it is known from."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tgslam.config.plane_settings import PlanesConfig
from tgslam.geometry import transform_points
from tgslam.planes.estimate import PlaneEstimate, concatenated, fuse
from tgslam.planes.identity import palette
from tgslam.planes.instances.support import Support

Vector = NDArray[np.float64]
Poses = Mapping[int, Vector]  # keyframe -> T_wc [4, 4]

NO_ID = -1
_KEEP_LATEST = 8  # views that thinning does not touch


class PlanarInstance:
    """One persistent plane. Its views stay in their cameras' frames, so that it follows when keyframes are moved.

    Normals point to the side that it is seen from: the two sides of a thin wall are two instances.
    """

    def __init__(self, plane: PlaneEstimate, config: PlanesConfig) -> None:
        """A candidate without views; `plane` is in the world."""
        self.id = NO_ID  # given once it counts
        self.plane = plane  # of all views, world
        self.latest = plane  # of the latest view, world, without the uncertainty of that view's pose
        self.support = Support(plane, config.cell_m)
        self.keyframes: list[int] = []  # all that saw it, ascending
        self.merged_into: PlanarInstance | None = None
        self.split_from: PlanarInstance | None = None
        self.part_of: PlanarInstance | None = None  # whose unevenness it is: then it goes by that one's id
        self.unseen = 0  # keyframes since it was last seen
        self.seen_past = False  # views have shown that what stands before a gap in it does not part it
        self.through = 0  # keyframes, one after the other, that see through it
        self.taken_by: PlanarInstance | None = None  # to which the latest keyframe to show it has counted it instead
        self.taken = 0  # such keyframes, one after the other
        self._config = config
        self._views: PlaneEstimate | None = None  # [N] each in its keyframe's camera, but for the surface's error
        self._view_keyframes: NDArray[np.int64] = np.zeros(0, np.int64)
        self._view_areas: Vector = np.zeros(0)  # m2
        self._view_rms_m: Vector = np.zeros(0)

    @property
    def is_candidate(self) -> bool:
        """Whether it waits for views to make it a PGI."""
        return self.id == NO_ID and self.part_of is None

    @property
    def normal_w(self) -> Vector:
        """[3] unit, towards the side that it is seen from."""
        return self.plane.normal

    @property
    def offset_m(self) -> float:
        """d of n . x + d = 0."""
        return float(self.plane.offset_m)

    @property
    def centroid_w(self) -> Vector:
        """[3] m, on the plane."""
        return self.plane.centroid

    @property
    def covariance(self) -> Vector:
        """[3, 3] of (rad, rad, m) about `geometry.tangent_axes` of the normal, at the centroid: as in PlaneSegment."""
        return self.plane.covariance

    @property
    def area_m2(self) -> float:
        """Of everything seen of it."""
        return self.support.area_m2

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the views' points from their planes, weighted by area."""
        return float(np.sqrt(self._view_areas @ self._view_rms_m**2 / self._view_areas.sum()))

    @property
    def colour(self) -> NDArray[np.float32]:
        """[3] RGB of Eq. 2."""
        return palette.colours(self.id)

    def polygons_w(self) -> list[Vector]:
        """Outlines [K, 3] m of its extent, world, largest first, counter-clockwise seen from its front."""
        return self.support.polygons()

    def view(self, keyframe: int, surface_sigma_m: float | None = None) -> PlaneEstimate | None:
        """The plane as that keyframe saw it, in its camera's frame; None where it did not or is no longer known.

        surface_sigma_m: by what the surface strays from its plane, None = as the settings say. Views that are held
        against each other take less: much of it they see alike.
        """
        index = np.flatnonzero(self._view_keyframes == keyframe)
        if self._views is None or len(index) == 0:
            return None
        sigma_m = self._config.model_sigma_m if surface_sigma_m is None else surface_sigma_m
        views = self._views[index].with_surface_error(self._view_areas[index], sigma_m)
        return views[0] if len(index) == 1 else fuse(views)

    def add_view(self, keyframe: int, local: PlaneEstimate, area_m2: float, rms_m: float, poses: Poses) -> None:
        """A plane in a keyframe's camera frame, as certain as the sensor's noise leaves it, is this one. Refits."""
        self._take(
            PlaneEstimate(*(np.asarray(part)[None] for part in vars(local).values())),
            np.array([keyframe]),
            np.array([max(area_m2, 1e-6)]),
            np.array([rms_m]),
        )
        self.keyframes = sorted({*self.keyframes, keyframe})
        self.unseen = self.through = 0
        self.refit(poses)

    def absorb(self, other: PlanarInstance, poses: Poses) -> None:
        """Take over all that another instance has: the two are one."""
        if other._views is not None:
            self._take(other._views, other._view_keyframes, other._view_areas, other._view_rms_m)
        self.keyframes = sorted({*self.keyframes, *other.keyframes})
        self.seen_past |= other.seen_past
        cells, keyframes = other.support.cells()
        self.support.absorb(other.support.centres(cells), keyframes)
        self.refit(poses)

    def refit(self, poses: Poses) -> None:
        """The plane that all views agree on, at the poses that their keyframes have now."""
        assert self._views is not None
        T_wc = np.stack([poses[int(k)] for k in self._view_keyframes])
        rough = self._views.with_surface_error(self._view_areas, self._config.model_sigma_m)
        bent = rough.with_sensor_bias(self._view_areas, self._config.bias_per_m2)
        world = bent.with_pose_error(self._config.pose_sigma_rad, self._config.pose_sigma_m).transformed(T_wc)
        self.plane = fuse(world, self._config.independent_views)
        self.latest = bent[-1].transformed(T_wc[-1])
        self.support.follow(self.plane)

    def move(self, corrections: Poses, poses: Poses) -> None:
        """Keyframes were moved: p_w <- corrections[keyframe] p_w. Cells go with the keyframe that saw them first."""
        cells, keyframes = self.support.cells()
        points = self.support.centres(cells)
        for keyframe in np.unique(keyframes):
            if int(keyframe) in corrections:
                own = keyframes == keyframe
                points[own] = transform_points(corrections[int(keyframe)], points[own])
        self.refit(poses)
        self.support = Support(self.plane, self.support.cell_m)
        self.support.absorb(points, keyframes)

    def split(self, poses: Poses) -> PlanarInstance | None:
        """Give back the smaller part of the views as an instance of its own, if they show two surfaces; else None.

        Two surfaces that were taken for one are seen now at one depth, now at the other. Drift also parts the views in
        two, but into earlier and later ones: that is no reason to split.
        """
        if self._views is None or (minority := self._minority(poses)) is None:
            return None
        other = PlanarInstance(self.plane, self._config)
        other.split_from = self
        other._take(self._views[minority], *self._rows(minority))
        own, rows = self._views[~minority], self._rows(~minority)
        self._views, (self._view_keyframes, self._view_areas, self._view_rms_m) = own, rows
        other.keyframes = sorted({int(k) for k in other._view_keyframes})
        self.keyframes = [k for k in self.keyframes if k not in other.keyframes]
        cells, keyframes = self.support.cells()
        points, moved = self.support.centres(cells), np.isin(keyframes, other._view_keyframes)
        for part, chosen in ((self, ~moved), (other, moved)):
            part.refit(poses)
            part.support = Support(part.plane, self.support.cell_m)
            part.support.absorb(points[chosen], keyframes[chosen])
        return other

    def _minority(self, poses: Poses) -> NDArray[np.bool_] | None:
        """Which views [N] show the less often seen of two surfaces; None where there is but one."""
        least = self._config.confirm_views
        assert self._views is not None
        if len(self._view_keyframes) < 2 * least:
            return None
        T_wc = np.stack([poses[int(k)] for k in self._view_keyframes])
        height = self.plane.heights_m(self._views.transformed(T_wc).centroid)
        ordered = np.sort(height)
        gaps = np.diff(ordered)[least - 1 : len(ordered) - least]
        cut = least - 1 + int(np.argmax(gaps))
        upper = height > 0.5 * (ordered[cut] + ordered[cut + 1])
        spread = np.hypot(np.std(height[upper]), np.std(height[~upper]))
        gap = ordered[cut + 1] - ordered[cut]
        if gap < self._config.gate_sigmas * max(float(spread), self._config.pose_sigma_m):
            return None
        turns = np.count_nonzero(np.diff(upper.astype(int)))  # views are in order of time
        if turns < least:
            return None
        return upper if upper.sum() * 2 <= len(upper) else ~upper

    def _rows(self, chosen: NDArray[np.bool_]) -> tuple[NDArray[np.int64], Vector, Vector]:
        return self._view_keyframes[chosen], self._view_areas[chosen], self._view_rms_m[chosen]

    def _take(self, views: PlaneEstimate, keyframes: NDArray[np.int64], areas: Vector, rms_m: Vector) -> None:
        """Add views [N], in order of keyframes; where that makes too many, drop those with the nearest neighbours."""
        if self._views is not None:
            views = concatenated(self._views, views)
            keyframes = np.concatenate([self._view_keyframes, keyframes])
            areas, rms_m = np.concatenate([self._view_areas, areas]), np.concatenate([self._view_rms_m, rms_m])
        kept = _thinned(np.argsort(keyframes, kind="stable"), keyframes, self._config.observations)
        self._views = views[kept]
        self._view_keyframes, self._view_areas, self._view_rms_m = keyframes[kept], areas[kept], rms_m[kept]


def _thinned(order: NDArray[np.int64], keyframes: NDArray[np.int64], limit: int) -> NDArray[np.int64]:
    """At most `limit` of the indices `order`, which sort the keyframes: first and latest stay, spread stays even."""
    while len(order) > limit:
        sorted_keyframes = keyframes[order]
        inner = sorted_keyframes[2:] - sorted_keyframes[:-2]
        order = np.delete(order, 1 + int(np.argmin(inner[: max(len(inner) - _KEEP_LATEST, 1)])))
    return order
