"""One keyframe's segments matched to the instances that there are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam.config.plane_settings import PlanesConfig
from tgslam.geometry import inverse
from tgslam.planes.estimate import PlaneEstimate, deviation_sigmas, stacked
from tgslam.planes.instances.association import Agreement, Overlap, assign, gate, matching_cost, overlap
from tgslam.planes.instances.gaps import Gap, adjoins, gap_between, narrowest, shortest_gap
from tgslam.planes.instances.instance import PlanarInstance
from tgslam.planes.instances.sight import Samples, Sight, Tolerance, may_appear, sight
from tgslam.planes.instances.support import Cells
from tgslam.planes.instances.view_planes import ViewPlanes

Vector = NDArray[np.float64]

_LEAST_COMMON = 4  # samples of two masks that overlap: fewer may be the noise of their borders
LEAST_SAMPLES = 12  # of a plane's extent in view, for the view to say something against it
WELL = 0.5  # of the gate: planes agree well
_MAIN_SHARE = 0.5  # of what a segment has in common with any instance that it fits, that it has with its own
_MOST = 0.5  # of a segment that lies on the extent of what it is no new part of
_SHARED_VIEWS = 5  # latest ones in which two instances are compared


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
        self.planes = ViewPlanes(samples.view, config.expert.uncertainty)
        self.owner: list[PlanarInstance | None] = [None] * len(samples.view.segments)
        self.sights = self._sights()
        self._known = len(self.instances)  # those after are new in this view
        self._careful, self._lenient = self._agreements()

    def give(
        self, segment: int, instance: PlanarInstance, keyframe: int, parted: Sequence[PlanarInstance] = ()
    ) -> None:
        """The segment shows the instance, which may be a new one; what it shows of those parted from it is theirs."""
        if instance not in self.instances:
            self.instances.append(instance)
        self.owner[segment] = instance
        footprint = self.samples.footprint(segment, instance.support)
        for other in parted:
            theirs = other.support.holds(other.support.cells_of(instance.support.centres(footprint)))
            footprint = footprint[instance.support.holds(footprint) | ~theirs]
        instance.support.add(footprint, keyframe)

    def overlapping(self, careful: bool) -> list[tuple[int, PlanarInstance]]:
        """The one-to-one assignment of what is not settled yet, segments to instances whose masks overlap: Eqs. 5 to 7.

        Carefully first. What is left over then is matched leniently, for a pose that has jumped farther than expected,
        but only where each covers most of the other.
        """
        free = [i for i, owner in enumerate(self.owner) if owner is None]
        seen = [i for i in self.sights if not self.pieces(self.instances[i])]
        if not free or not seen:
            return []
        instances = [self.instances[i] for i in seen]
        masks = self._overlap(seen)
        agreement = (self._careful if careful else self._lenient)[np.ix_(free, seen)]
        allowed = agreement.admitted & self._meet(masks)[free]
        limits = self.config.expert.association
        allowed &= masks.iou[free] >= (limits.careful_iou if careful else limits.lenient_iou)
        # A piece of one surface is no other surface that happens to have a part of its extent
        common = np.where(agreement.admitted, masks.intersection[free], 0)
        allowed &= common >= _MAIN_SHARE * common.max(axis=1, keepdims=True)
        pairs = assign(matching_cost(agreement, masks.iou[free], self.config), allowed)
        return [(free[row], instances[column]) for row, column in pairs]

    def continued(self, segment: int) -> PlanarInstance | None:
        """The instance whose surface an unmatched segment continues: overlaps, adjoins, or goes on behind what hides
        the gap. Of several, the one that has most of it beside its extent and fits best.

        An instance with other segments in this very view has to be coplanar with those, which the camera's pose has no
        part in. Any other one has to overlap as for the one-to-one assignment, or to fit well.
        """
        new = len(self.instances) - self._known  # these are in this view, which is what decides
        admitted = np.append(self._lenient.admitted[segment], np.ones(new, bool))
        gate_sigmas, max_gap_m = self.config.expert.association.gate_sigmas, self.config.expert.gaps.max_gap_m
        misfit = np.append(self._careful.deviation_sigmas[segment] / gate_sigmas, np.zeros(new))
        best, best_score = None, -np.inf
        for i in np.flatnonzero(admitted):
            instance = self.instances[i]
            pieces = self.pieces(instance)
            if any(self.planes.is_step(segment, piece) for piece in pieces):
                continue
            fits_well = bool(misfit[i] <= WELL)
            if not (self._coplanar(segment, pieces) if pieces else fits_well or self._overlaps(segment, int(i))):
                continue
            footprint = self.samples.footprint(segment, instance.support)
            beside = instance.support.near(footprint, max_gap_m)
            if not self._joined(segment, footprint, instance, fits_well) or self.is_parted(segment, instance):
                continue
            score = float(np.mean(beside) - misfit[i])
            if score > best_score:
                best, best_score = instance, score
        return best

    def steps(self) -> list[tuple[PlanarInstance, PlanarInstance]]:
        """The instances that this view shows with a step between them."""
        pairs = [(self.owner[i], self.owner[j]) for i, j in sorted(self.samples.view.steps)]
        return [(a, b) for a, b in pairs if a is not None and b is not None and a is not b]

    def parted(self, segment: int) -> list[PlanarInstance]:
        """The instances over whose extent an unmatched segment lies, but beyond a gap that parts it from them."""
        return [
            instance
            for instance in self.instances
            if self.pieces(instance)
            and self._coplanar(segment, self.pieces(instance))
            and instance.support.holds(self.samples.footprint(segment, instance.support)).any()
            and self.is_parted(segment, instance)
        ]

    def beyond_gap(self, segment: int, instance: PlanarInstance) -> tuple[Vector, NDArray[np.int32]]:
        """Take the part of an instance's extent over which a segment lies from it: `Support.take_part`."""
        kept = [self.samples.footprint(piece, instance.support) for piece in self.pieces(instance)]
        return instance.support.take_part(self.samples.footprint(segment, instance.support), np.concatenate(kept))

    def world(self, segment: int) -> PlaneEstimate:
        """A segment's plane in the world."""
        return self.planes.bent[segment].transformed(inverse(self.samples.T_cw))

    def pieces(self, instance: PlanarInstance) -> list[int]:
        """The segments that show an instance."""
        return [segment for segment, owner in enumerate(self.owner) if owner is instance]

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

    def _agreements(self) -> tuple[Agreement, Agreement]:
        """Of the segments [S] with the instances [G], carefully and leniently.

        Carefully: with the latest view or with all of them, the pose being uncertain by what it may have drifted since
        the latest, which tells surfaces a few centimetres apart. Leniently: with all views, at the full uncertainty.
        """
        config, position = self.config, self.samples.position_w
        error = config.expert.uncertainty
        drift = np.sqrt(1.0 + np.array([i.record.unseen for i in self.instances], np.float64))[None]
        local, T_wc = self.planes.bent[:, None], inverse(self.samples.T_cw)
        all_views, latest = (stacked([getattr(i, name) for i in self.instances]) for name in ("plane", "latest"))
        near = local.with_pose_error(
            np.minimum(drift * error.step_sigma_rad, error.pose_sigma_rad),
            np.minimum(drift * error.step_sigma_m, error.pose_sigma_m),
        ).transformed(T_wc)
        far = local.with_pose_error(error.pose_sigma_rad, error.pose_sigma_m).transformed(T_wc)
        careful = gate(near, all_views[None], position, config).or_better(gate(near, latest[None], position, config))
        return careful, gate(far, all_views[None], position, config)

    def _overlap(self, seen: list[int]) -> Overlap:
        """Of all segments with some of the instances in sight."""
        return overlap(self.samples.label, len(self.owner), [self.sights[i].shown for i in seen])

    def _meet(self, masks: Overlap) -> NDArray[np.bool_]:
        """[S, G]: whether masks overlap enough."""
        least = self.config.expert.association.min_mask_overlap
        return (masks.containment >= least) & (masks.intersection >= _LEAST_COMMON)

    def _overlaps(self, segment: int, index: int) -> bool:
        return index in self.sights and bool(self._meet(self._overlap([index]))[segment, 0])

    def _coplanar(self, segment: int, pieces: list[int]) -> bool:
        return bool(np.all(self.planes.misfit_sigmas[segment, pieces] <= self.config.expert.association.gate_sigmas))

    def is_parted(self, segment: int, instance: PlanarInstance) -> bool:
        """Whether gaps part a segment from all others that show the instance, and its extent does not connect them:
        then it was taken for one with them from afar.
        """
        pieces = self.pieces(instance)
        own = self.samples.footprint(segment, instance.support)
        whole = instance.record.seen_past and float(np.mean(instance.support.holds(own))) > _MOST
        for piece in pieces:
            other = self.samples.footprint(piece, instance.support)
            ways = narrowest(instance.support, own, other)
            if ways is None or instance.support.connects(own, other):
                return False
            gap, larger_m2 = self._gap(ways, instance), max(self.planes.areas_m2[[segment, piece]])
            if not (gap.open if whole else gap.parts(larger_m2, self.config.expert.gaps)):
                return False
        return bool(pieces)

    def _joined(self, segment: int, footprint: Cells, instance: PlanarInstance, fits_well: bool) -> bool:
        """Whether a footprint adjoins an instance or, if it fits well, has a short gap to it that is hidden; and the
        gap does not part them.
        """
        config = self.config.expert.gaps
        adjoining = adjoins(instance.support.near(footprint, config.max_gap_m))
        ways = shortest_gap(instance.support, footprint, config.bridge_m)
        if ways is None:
            return adjoining
        gap = self._gap(ways, instance)
        if gap.parts(max(instance.area_m2, self.planes.areas_m2[segment]), config):
            return False
        return adjoining or (fits_well and gap.hidden)

    def _gap(self, ways: tuple[Vector, Vector], instance: PlanarInstance) -> Gap:
        return gap_between(self.samples, ways, instance.plane, self.tolerance, self.config.expert.gaps.close_before_m)


def coplanar_in_views(a: PlanarInstance, b: PlanarInstance) -> float | None:
    """By how many sigmas two instances deviate in the latest views that show both (median); None without such views.

    The poses of the views have no part in it.
    """
    shared = [k for k in a.keyframes if k in b.keyframes]
    pairs = [(first, second) for k in shared[-_SHARED_VIEWS:] if (first := a.view(k)) and (second := b.view(k))]
    if not pairs:
        return None
    ours, theirs = (stacked(side) for side in zip(*pairs, strict=True))
    return float(np.median(np.maximum(deviation_sigmas(ours, theirs), deviation_sigmas(theirs, ours))))
