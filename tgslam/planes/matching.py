"""One keyframe's segments matched to the instances that there are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tgslam.config.schema import PlanesConfig
from tgslam.planes.association import Agreement, assign, gate, matching_cost, overlap
from tgslam.planes.estimate import PlaneEstimate, deviation_sigmas, from_segments, fuse, stacked
from tgslam.planes.instance import PlanarInstance, world_views
from tgslam.planes.sight import Samples, Sight, Tolerance, hidden_between, may_appear, sight
from tgslam.planes.support import Cells, Support

_CONTACT_CELLS = 3  # in which two surfaces must adjoin
_LEAST_SAMPLES = 4  # common to two masks
_DEFERRED_VARIANCE = 4.0  # factor by which an ambiguous segment is less certain than it says


class ViewMatching:
    """Which instance each segment of a keyframe shows.

    First one to one, where masks overlap (Eqs. 5 to 7); then the pieces that are left over go to the instances that
    they continue. `give` settles a segment, and lets its instance grow at once for the pieces that come after it.
    """

    def __init__(
        self, samples: Samples, instances: Sequence[PlanarInstance], config: PlanesConfig, tolerance: Tolerance
    ) -> None:
        self.samples, self.config, self.tolerance = samples, config, tolerance
        self.instances = list(instances)
        self.segments = samples.view.segments
        self.local = _with_model_error(from_segments(self.segments), self._areas_m2(), config.model_sigma_m)
        self.local.covariance[[not s.reliable for s in self.segments]] *= _DEFERRED_VARIANCE
        self.world = world_views(self.local, samples.T_cw, config)
        self.owner: list[PlanarInstance | None] = [None] * len(self.segments)
        self.sights = self._sights()

    def give(self, segment: int, instance: PlanarInstance, keyframe: int) -> None:
        """The segment shows the instance, which may be a new one."""
        if instance not in self.instances:
            self.instances.append(instance)
        self.owner[segment] = instance
        instance.support.add(self.samples.footprint(segment, instance.support), keyframe)

    def overlapping(self) -> list[tuple[int, PlanarInstance]]:
        """The one-to-one assignment: segments and the instances that their masks overlap, by Eqs. 5 to 7."""
        if not self.segments or not self.sights:
            return []
        seen = [self.instances[i] for i in self.sights]
        agreement = self._agreement(self.world, seen)
        masks = overlap(self.samples.label, len(self.segments), [s.shown for s in self.sights.values()])
        allowed = agreement.admitted & (masks.containment >= self.config.min_overlap)
        allowed &= masks.intersection >= _LEAST_SAMPLES
        pairs = assign(matching_cost(agreement, masks.iou, self.config), allowed)
        return [(segment, seen[column]) for segment, column in pairs]

    def continued(self, segment: int) -> PlanarInstance | None:
        """The best-fitting instance whose surface an unmatched segment continues: overlaps, adjoins, or goes on behind
        what hides the gap. An instance with other segments in this very view has to be coplanar with those, which the
        camera's pose has no part in.
        """
        if not self.instances:
            return None
        agreement = self._agreement(self.world[segment : segment + 1], self.instances)
        for i in np.argsort(agreement.deviation_sigmas[0], kind="stable"):
            instance = self.instances[int(i)]
            if not agreement.admitted[0, i]:
                continue
            pieces = self.pieces(instance)
            if pieces and not self._coplanar(segment, pieces):
                continue
            footprint = self.samples.footprint(segment, instance.support)
            if adjoins(instance.support, footprint, self.config.max_gap_m) or (
                pieces and self._bridged(footprint, instance)
            ):
                return instance
        return None

    def pieces(self, instance: PlanarInstance) -> list[int]:
        """The segments that show an instance."""
        return [segment for segment, owner in enumerate(self.owner) if owner is instance]

    def combined(self, pieces: list[int]) -> tuple[PlaneEstimate, float, float]:
        """One plane from several segments: in the camera's frame, with its area in m2 and RMS in m."""
        areas = self._areas_m2()[pieces]
        rms_m = np.array([self.segments[piece].rms_m for piece in pieces])
        plane = self.local[pieces[0]] if len(pieces) == 1 else fuse(self.local[pieces])
        return plane, float(areas.sum()), float(np.sqrt(areas @ rms_m**2 / max(areas.sum(), 1e-12)))

    def _areas_m2(self) -> NDArray[np.float64]:
        return np.array([segment.area_m2 for segment in self.segments], np.float64)

    def _sights(self) -> dict[int, Sight]:
        """What the view says of each instance that may be in it, by index."""
        if not self.instances:
            return {}
        corners = np.stack([instance.support.corners() for instance in self.instances])
        near = may_appear(self.samples, stacked([instance.plane for instance in self.instances]), corners)
        return {
            int(i): sight(self.samples, self.instances[i].plane, self.instances[i].support, self.tolerance)
            for i in np.flatnonzero(near)
        }

    def _agreement(self, planes: PlaneEstimate, instances: Sequence[PlanarInstance]) -> Agreement:
        """Of planes [S] with instances [G]: with what all their views say, or with the latest view.

        Drift sets old views off against the present pose, but hardly the latest one.
        """
        position = self.samples.position_w
        rows = planes[:, None]
        all_views, latest = stacked([i.plane for i in instances]), stacked([i.latest for i in instances])
        return gate(rows, all_views[None], position, self.config).or_better(
            gate(rows, latest[None], position, self.config)
        )

    def _coplanar(self, segment: int, pieces: list[int]) -> bool:
        own, others = self.local[segment : segment + 1], self.local[pieces]
        sigmas = np.maximum(deviation_sigmas(own, others), deviation_sigmas(others, own))
        return bool(np.all(sigmas <= self.config.gate_sigmas))

    def _bridged(self, footprint: Cells, instance: PlanarInstance) -> bool:
        """Whether the gap between a footprint and an instance is short and hidden all the way."""
        cells, _ = instance.support.cells()
        distance, nearest = cKDTree(cells).query(footprint)
        closest = int(np.argmin(distance))
        if distance[closest] * instance.support.cell_m > self.config.bridge_m:
            return False
        start, end = instance.support.centres(np.stack([footprint[closest], cells[nearest[closest]]]))
        return hidden_between(self.samples, start, end, instance.plane, self.tolerance)


def adjoins(support: Support, cells: Cells, gap_m: float) -> bool:
    """Whether cells [N, 2] of a surface's grid overlap its extent or border on it without a gap."""
    return int(support.near(cells, gap_m).sum()) >= min(_CONTACT_CELLS, len(cells)) > 0


def same_surface(a: PlanarInstance, b: PlanarInstance, config: PlanesConfig) -> bool:
    """Whether two instances that agree in the world are one: coplanar in the views that show both, and adjoining."""
    shared = [k for k in a.keyframes if k in b.keyframes]
    pairs = [(first, second) for k in shared[-5:] if (first := a.view(k)) and (second := b.view(k))]
    if pairs:
        ours, theirs = (stacked(side) for side in zip(*pairs, strict=True))
        apart = np.maximum(deviation_sigmas(ours, theirs), deviation_sigmas(theirs, ours))
        if np.median(apart) > config.gate_sigmas:
            return False
    small, large = sorted((a, b), key=lambda instance: len(instance.support))
    cells = large.support.cells_of(small.support.centres(small.support.cells()[0]))
    return adjoins(large.support, np.unique(cells, axis=0), config.max_gap_m)


def _with_model_error(planes: PlaneEstimate, areas_m2: NDArray[np.float64], sigma_m: float) -> PlaneEstimate:
    """Real surfaces stray from a plane by so much, which leaves its angle uncertain by as much over its size."""
    variance = np.full((len(areas_m2), 3), sigma_m**2)
    variance[:, :2] /= np.maximum(areas_m2, 1e-4)[:, None]
    return replace(planes, covariance=planes.covariance + variance[:, :, None] * np.eye(3))
