"""The set of Planar Gaussian Instances: how they begin, grow, merge, split and end (section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.config.schema import PlanesConfig
from tgslam.geometry import inverse
from tgslam.planes.association import gate
from tgslam.planes.estimate import PlaneEstimate, stacked
from tgslam.planes.instance import NO_ID, PlanarInstance, Poses
from tgslam.planes.matching import WELL, ViewMatching, adjoins, coplanar_in_views, shortest_gap
from tgslam.planes.segment import PlaneView
from tgslam.planes.sight import Samples, Sight, Tolerance, gap_between
from tgslam.types import Camera, FloatImage

_LEAST_SAMPLES = 12  # of a plane's extent in view, for the view to say something against it
_MOST = 0.5
_SUSPECT_PLANES = 3  # so many contradicted at once, and more than confirmed: the pose is wrong, not the planes


@dataclass(frozen=True)
class Observation:
    """What a keyframe's planes are, and what became of the instances."""

    keyframe: int
    ids: NDArray[np.int32]  # [S] PGI of each segment; -1 = deferred
    created: tuple[int, ...]  # PGIs that this keyframe made or confirmed
    merged: tuple[tuple[int, int], ...]  # (kept, absorbed)
    removed: tuple[int, ...]

    def id_image(self, labels: NDArray[np.int32]) -> NDArray[np.int32]:
        """The PGI of each pixel [H, W], -1 = none, for the labels of the PlaneView: id(u) of Eq. 2."""
        return np.append(self.ids, np.int32(NO_ID))[labels]


class PlaneRegistry:
    """All PGIs of a run. Ids count up from 0 and are never used again.

    A reliable segment that matches nothing is a PGI at once. An ambiguous one is a candidate: it becomes a PGI, with
    its first keyframe, when further views or a reliable segment confirm it, and is dropped when they do not.
    """

    def __init__(self, config: PlanesConfig, depth_sigma_per_m2: float) -> None:
        """depth_sigma_per_m2: the sensor's noise, sigma_z = this * z^2."""
        self._config = config
        self._tolerance = Tolerance(config.gate_sigmas, depth_sigma_per_m2, config.pose_sigma_rad, config.pose_sigma_m)
        self._instances: list[PlanarInstance] = []  # candidates included, oldest first
        self._poses: dict[int, NDArray[np.float64]] = {}  # keyframe -> T_wc [4, 4]
        self._absorbed_by: dict[int, int] = {}
        self._apart: set[frozenset[PlanarInstance]] = set()  # coplanar pairs between which a view looks through
        self._next_id = 0

    @property
    def instances(self) -> dict[int, PlanarInstance]:
        """The PGIs by id, ascending. Candidates are not among them."""
        return {i.id: i for i in sorted(self._instances, key=lambda instance: instance.id) if i.id != NO_ID}

    @property
    def id_count(self) -> int:
        """How many ids have been given."""
        return self._next_id

    @property
    def candidate_count(self) -> int:
        """Ambiguous surfaces that wait for further views."""
        return sum(instance.id == NO_ID for instance in self._instances)

    def resolve(self, plane_id: int) -> int:
        """The id under which a PGI lives on after merges; -1 for one that was removed."""
        while plane_id in self._absorbed_by:
            plane_id = self._absorbed_by[plane_id]
        return plane_id if any(instance.id == plane_id for instance in self._instances) else NO_ID

    def seen_from(self, keyframe: int) -> dict[int, PlaneEstimate]:
        """The PGIs that a keyframe saw, by id, each as it saw it: in its camera's frame."""
        views = {i: instance.view(keyframe) for i, instance in self.instances.items() if keyframe in instance.keyframes}
        return {i: view for i, view in views.items() if view is not None}

    def observe(
        self, view: PlaneView, depth_m: FloatImage, camera: Camera, T_cw: NDArray[np.float64], keyframe: int
    ) -> Observation:
        """Match a keyframe's planes to the PGIs, and let them grow, begin, merge, split and end.

        depth_m: [H, W] m on the host, as the view was made from. keyframe: a number that grows from call to call.
        """
        self._poses[keyframe] = inverse(T_cw)
        samples = Samples.of(view, depth_m, camera, T_cw, self._config.mask_width_px)
        matching = ViewMatching(samples, self._instances, self._config, self._tolerance)
        self._match(matching, keyframe)
        seen = self._integrate(matching, keyframe)
        created = self._confirm(seen, matching)
        removed = self._weigh_contradictions(matching, seen)
        created += self._split(seen)
        merged = self._merge(seen, samples)
        ids = [self._id_of(owner, keyframe) for owner in matching.owner]
        return Observation(keyframe, np.array(ids, np.int32), tuple(created), tuple(merged), tuple(removed))

    def moved(self, corrections: Poses) -> tuple[tuple[int, int], ...]:
        """Keyframes have moved in the world: p_w <- corrections[keyframe] p_w, [4, 4] each; the others stay.

        PGIs are computed again from their keyframes' views. Returns merges (kept, absorbed) of those that now coincide.
        """
        for keyframe, correction in corrections.items():
            if keyframe in self._poses:
                self._poses[keyframe] = correction @ self._poses[keyframe]
        affected = [i for i in self._instances if any(k in corrections for k in i.keyframes)]
        for instance in affected:
            instance.move(corrections, self._poses)
        return tuple(self._merge(affected, None))

    def _match(self, matching: ViewMatching, keyframe: int) -> None:
        """Give every segment its instance; new ones for those that neither overlap nor continue one that there is."""
        for careful in (True, False):
            for segment, instance in matching.overlapping(careful):
                matching.give(segment, instance, keyframe)
        for segment in range(len(matching.segments)):
            if matching.owner[segment] is None:
                found = matching.continued(segment)
                matching.give(segment, found or PlanarInstance(matching.world(segment), self._config), keyframe)

    def _integrate(self, matching: ViewMatching, keyframe: int) -> list[PlanarInstance]:
        """Hand each instance its view; returns the instances in view, oldest first."""
        seen = [instance for instance in matching.instances if matching.pieces(instance)]
        for instance in seen:
            instance.add_view(keyframe, *matching.combined(matching.pieces(instance)), self._poses)
        self._instances = matching.instances
        return seen

    def _confirm(self, seen: list[PlanarInstance], matching: ViewMatching) -> list[int]:
        """Candidates that have become PGIs. Those that have not for too long are dropped."""
        created = []
        for instance in seen:
            reliable = any(matching.segments[piece].reliable for piece in matching.pieces(instance))
            if instance.id == NO_ID and (reliable or len(instance.keyframes) >= self._config.confirm_views):
                created.append(self._name(instance))
        for instance in self._instances:
            instance.unseen += instance not in seen
        limit = self._config.candidate_keyframes
        self._instances = [i for i in self._instances if i.id != NO_ID or i.unseen <= limit]
        return created

    def _weigh_contradictions(self, matching: ViewMatching, seen: list[PlanarInstance]) -> list[int]:
        """Take back what the view sees through; the ids of PGIs of which nothing is left, or no view speaks for."""
        sights = [(matching.instances[i], s) for i, s in matching.sights.items()]
        against = [instance for instance, s in sights if instance not in seen and self._contradicts(s)]
        if len(against) >= max(_SUSPECT_PLANES, len(seen) + 1):
            return []
        for instance, view in sights:
            instance.support.weaken(view.through_cells)
            if instance in against:
                instance.through += 1
            elif len(view.shown) >= _LEAST_SAMPLES:
                instance.through = 0
        ended = [i for i in self._instances if self._is_refuted(i)]
        self._instances = [i for i in self._instances if i not in ended]
        return [instance.id for instance in ended if instance.id != NO_ID]

    def _contradicts(self, view: Sight) -> bool:
        visible = view.through_count + len(view.shown)
        return visible >= _LEAST_SAMPLES and view.through_share >= self._config.through_share

    def _is_refuted(self, instance: PlanarInstance) -> bool:
        """One view that sees through it is enough against a candidate."""
        limit = 1 if instance.id == NO_ID else self._config.through_keyframes
        return instance.through >= limit or len(instance.support) == 0

    def _split(self, seen: list[PlanarInstance]) -> list[int]:
        """Instances that turn out to be two surfaces become two; the ids of the new ones."""
        parts = [part for instance in seen if (part := instance.split(self._poses)) is not None]
        self._instances += parts
        return [self._name(part) for part in parts]

    def _merge(self, touched: list[PlanarInstance], samples: Samples | None) -> list[tuple[int, int]]:
        """Make one of each pair of instances that turn out to be the same surface; (kept, absorbed) of PGIs."""
        merged = []
        while (twins := self._twins([i for i in touched if i in self._instances], samples)) is not None:
            # A PGI before a candidate, then the older one
            kept, absorbed = sorted(twins, key=lambda i: (i.id == NO_ID, i.id, i.keyframes[0]))
            kept.absorb(absorbed, self._poses)
            self._instances = [i for i in self._instances if i is not absorbed]
            self._apart = {frozenset(kept if i is absorbed else i for i in pair) for pair in self._apart}
            touched = [*touched, kept]
            if absorbed.id != NO_ID:
                self._absorbed_by[absorbed.id] = kept.id
                merged.append((kept.id, absorbed.id))
        return merged

    def _twins(
        self, touched: list[PlanarInstance], samples: Samples | None
    ) -> tuple[PlanarInstance, PlanarInstance] | None:
        """An instance out of `touched`, and another one, that are the same surface."""
        config = self._config
        ours = stacked([i.plane for i in touched])[:, None]
        theirs = stacked([i.plane for i in self._instances])[None].widened(config.pose_sigma_rad, config.pose_sigma_m)
        origin = np.zeros(3)  # decides on offset ratios only, which are not used here
        forth, back = gate(theirs, ours, origin, config), gate(ours, theirs, origin, config)
        sigmas = np.maximum(forth.deviation_sigmas, back.deviation_sigmas)
        for i, j in np.argwhere(forth.admitted & back.admitted):
            a, b = touched[i], self._instances[j]
            if a is not b and self._coplanar(a, b, float(sigmas[i, j])) and self._joined(a, b, samples):
                return a, b
        return None

    def _coplanar(self, a: PlanarInstance, b: PlanarInstance, sigmas: float) -> bool:
        """In the views that show both or, without any, in the world, where they deviate by `sigmas`: by half the gate
        unless the extent of one lies for the most part in that of the other.
        """
        in_views = coplanar_in_views(a, b)
        if in_views is not None:
            return in_views <= self._config.gate_sigmas
        if sigmas <= WELL * self._config.gate_sigmas:
            return True
        large, cells = _on_larger(a, b)
        return sigmas <= self._config.gate_sigmas and float(np.mean(large.support.holds(cells))) > _MOST

    def _joined(self, a: PlanarInstance, b: PlanarInstance, samples: Samples | None) -> bool:
        """Whether two coplanar instances adjoin, or have a gap that is hidden or, between large surfaces, out of view.

        Floors, walls and ceilings go on behind things and where no view has looked; table tops are smaller. A gap that
        any view has looked through parts two instances for good.
        """
        large, cells = _on_larger(a, b)
        if adjoins(large.support.near(cells, self._config.max_gap_m)):
            return True
        if samples is None or frozenset((a, b)) in self._apart:
            return False
        gap = shortest_gap(large.support, cells, self._config.bridge_m)
        if gap is None:
            return False
        seen_through, in_image = gap_between(samples, *gap, large.plane, self._tolerance)
        if seen_through:
            self._apart.add(frozenset((a, b)))
            return False
        return in_image or min(a.area_m2, b.area_m2) >= self._config.bridge_area_m2

    def _name(self, instance: PlanarInstance) -> int:
        instance.id = self._next_id
        self._next_id += 1
        return instance.id

    def _id_of(self, owner: PlanarInstance | None, keyframe: int) -> int:
        """The id of a segment's instance after this keyframe's merges and splits."""
        while owner is not None and owner.merged_into is not None:
            owner = owner.merged_into
        if owner is None:
            return NO_ID
        split_off = [i.id for i in self._instances if i.split_from is owner and keyframe in i.keyframes]
        return split_off[-1] if split_off and keyframe not in owner.keyframes else owner.id


def _on_larger(a: PlanarInstance, b: PlanarInstance) -> tuple[PlanarInstance, NDArray[np.int64]]:
    """The one of larger extent, and the cells [N, 2] of its grid over which the extent of the other lies."""
    small, large = sorted((a, b), key=lambda instance: len(instance.support))
    return large, np.unique(large.support.cells_of(small.support.centres(small.support.cells()[0])), axis=0)
