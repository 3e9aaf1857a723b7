"""A Planar Gaussian Instance (PGI): a plane of the world that persists, and the views it is known from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.config.plane_settings import PlanesConfig
from tgslam.geometry import transform_points
from tgslam.planes.estimate import PlaneEstimate
from tgslam.planes.identity import palette
from tgslam.planes.instances.lineage import Lineage
from tgslam.planes.instances.splitting import minority
from tgslam.planes.instances.support import Support
from tgslam.planes.instances.track_record import TrackRecord
from tgslam.planes.instances.views import Poses, Vector, Views

NO_ID = palette.NO_PLANE


class PlanarInstance:
    """One persistent plane. Its views stay in their cameras' frames, so that it follows when keyframes are moved.

    Normals point to the side that it is seen from: the two sides of a thin wall are two instances.
    """

    def __init__(self, plane: PlaneEstimate, config: PlanesConfig) -> None:
        """A candidate without views; `plane` is in the world."""
        self.id = NO_ID  # given once it counts
        self.plane = plane  # of all views, world
        self.latest = plane  # of the latest view, world, without the uncertainty of that view's pose
        self.support = Support(plane, config.expert.lifetime.extent_cell_m)
        self.keyframes: list[int] = []  # all that saw it, ascending; of some, the view is no longer kept
        self.lineage = Lineage()
        self.record = TrackRecord()
        self._config = config
        self._views = Views.none()

    @property
    def is_candidate(self) -> bool:
        """Whether it waits for views to make it a PGI."""
        return self.id == NO_ID and self.lineage.part_of is None

    @property
    def split_from(self) -> PlanarInstance | None:
        """The one that it was taken for a part of."""
        return self.lineage.split_from

    @property
    def heir(self) -> PlanarInstance:
        """The one under whose id it lives on: itself unless it was merged into another one, or is a part of one."""
        found = self
        while (heir := found.lineage.heir) is not None:
            found = heir
        return found

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
        return self._views.mean_rms_m

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
        sigma_m = self._config.expert.uncertainty.planarity_sigma_m if surface_sigma_m is None else surface_sigma_m
        return self._views.of(keyframe, sigma_m)

    def views(self, surface_sigma_m: float) -> dict[int, PlaneEstimate]:
        """All views that are still known, by keyframe; see `view`."""
        return self._views.by_keyframe(surface_sigma_m)

    def add_view(self, keyframe: int, local: PlaneEstimate, area_m2: float, rms_m: float, poses: Poses) -> None:
        """A plane in a keyframe's camera frame, as certain as the sensor's noise leaves it, is this one. Refits."""
        self._take(Views.one(keyframe, local, area_m2, rms_m))
        self.keyframes = sorted({*self.keyframes, keyframe})
        self.record.seen()
        self.refit(poses)

    def absorb(self, other: PlanarInstance, poses: Poses) -> None:
        """Take over all that another instance has: the two are one."""
        self._take(other._views)
        self.keyframes = sorted({*self.keyframes, *other.keyframes})
        self.lineage.revision += 1
        self.record.seen_past |= other.record.seen_past
        cells, keyframes = other.support.cells()
        self.support.absorb(other.support.centres(cells), keyframes)
        self.refit(poses)

    def refit(self, poses: Poses) -> None:
        """The plane that all views agree on, at the poses that their keyframes have now."""
        self.plane, self.latest = self._views.fused(poses, self._config.expert.uncertainty)
        self.support.follow(self.plane)

    def follow(self, motions: Poses, poses: Poses) -> None:
        """Keyframes have moved to these poses: p_w <- motions[keyframe] p_w.

        Cells go with the keyframe that saw them first.
        """
        cells, keyframes = self.support.cells()
        points = self.support.centres(cells)
        for keyframe in np.unique(keyframes):
            if int(keyframe) in motions:
                own = keyframes == keyframe
                points[own] = transform_points(motions[int(keyframe)], points[own])
        self.refit(poses)
        self.support = Support(self.plane, self.support.cell_m)
        self.support.absorb(points, keyframes)

    def split(self, poses: Poses) -> PlanarInstance | None:
        """Give back the smaller part of the views as an instance of its own, if they show two surfaces; else None."""
        fewer = minority(self._views, self.plane, poses, self._config)
        if fewer is None:
            return None
        other = PlanarInstance(self.plane, self._config)
        other.lineage.split_from = self
        other._take(self._views[fewer])
        self._views = self._views[~fewer]
        self.lineage.revision += 1
        other.keyframes = sorted({int(k) for k in other._views.keyframes})
        self.keyframes = [k for k in self.keyframes if k not in other.keyframes]
        cells, keyframes = self.support.cells()
        points, moved = self.support.centres(cells), np.isin(keyframes, other._views.keyframes)
        for part, chosen in ((self, ~moved), (other, moved)):
            part.refit(poses)
            part.support = Support(part.plane, self.support.cell_m)
            part.support.absorb(points[chosen], keyframes[chosen])
        return other

    def _take(self, views: Views) -> None:
        self._views = self._views.joined(views, self._config.expert.lifetime.kept_views)
