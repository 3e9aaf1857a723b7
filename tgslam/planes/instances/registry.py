"""The set of Planar Gaussian Instances: how they begin, grow, merge, split and end (section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.plane_settings import PlanesConfig
from tgslam.planes.estimate import PlaneEstimate
from tgslam.planes.instances.directions import stands_as_known
from tgslam.planes.instances.instance import NO_ID, PlanarInstance, Poses
from tgslam.planes.instances.joining import Joining
from tgslam.planes.instances.known_steps import with_known_steps
from tgslam.planes.instances.matching import LEAST_SAMPLES, ViewMatching
from tgslam.planes.instances.plane_table import PlaneTable
from tgslam.planes.instances.sight import Samples, Sight, Tolerance
from tgslam.planes.instances.unevenness import is_part
from tgslam.planes.segment import PlaneView
from tgslam.types import FloatImage

_SUSPECT_PLANES = 3  # so many contradicted at once, and more than confirmed: the pose is wrong, not the planes


@dataclass(frozen=True)
class Observation:
    """What a keyframe's planes are, and what became of the instances."""

    keyframe: int
    ids: NDArray[np.int32]  # [S] PGI of each segment; -1 = deferred
    created: tuple[int, ...]  # PGIs that this keyframe made or confirmed
    merged: tuple[tuple[int, int], ...]  # (kept, absorbed)
    removed: tuple[int, ...]
    corrected: tuple[int, ...]  # PGIs that have lost a part of their extent to one that a gap parts from them

    def id_image(self, labels: NDArray[np.int32]) -> NDArray[np.int32]:
        """The PGI of each pixel [H, W], -1 = none, for the labels of the PlaneView: id(u) of Eq. 2."""
        return np.append(self.ids, np.int32(NO_ID))[labels]


class PlaneRegistry:
    """All PGIs of a run. Ids count up from 0 and are never used again.

    A reliable segment that matches nothing is a PGI at once. An ambiguous one is a candidate: it becomes a PGI, with
    its first keyframe, when further views or a reliable segment confirm it, and is dropped when they do not. What is
    but the unevenness of a larger PGI goes by that one's id, and is kept so that later views find it again.
    """

    def __init__(self, config: PlanesConfig, noise: SensorNoise, poses: Poses) -> None:
        """poses: keyframe -> T_wc [4, 4], kept by somebody else."""
        depth_sigma_per_m2 = noise.per_m2
        self._config = config
        self.version = 0
        self._tolerance = Tolerance(config.gate_sigmas, depth_sigma_per_m2, config.pose_sigma_rad, config.pose_sigma_m)
        self._instances: list[PlanarInstance] = []  # candidates included, oldest first
        self._poses = poses
        self._absorbed_by: dict[int, int] = {}
        self._joining = Joining(config, self._tolerance)
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
        return sum(instance.is_candidate for instance in self._instances)

    def resolve(self, plane_id: int) -> int:
        """The id under which a PGI lives on after merges; -1 for one that was removed."""
        while plane_id in self._absorbed_by:
            plane_id = self._absorbed_by[plane_id]
        return plane_id if any(instance.id == plane_id for instance in self._instances) else NO_ID

    def seen_from(self, keyframe: int, surface_sigma_m: float | None = None) -> dict[int, PlaneEstimate]:
        """The PGIs that a keyframe saw, by id, each as it saw it: `PlanarInstance.view`."""
        seen = {i: instance for i, instance in self.instances.items() if keyframe in instance.keyframes}
        views = {i: instance.view(keyframe, surface_sigma_m) for i, instance in seen.items()}
        return {i: view for i, view in views.items() if view is not None}

    def parted_from(self, plane_id: int) -> list[PlanarInstance]:
        """The PGIs level with one that a gap parts from it."""
        known = self.instances
        if plane_id not in known:
            return []
        return [other for other in self._joining.parted_from(known[plane_id]) if other.id in known]

    def with_known_steps(
        self, view: PlaneView, depth_m: FloatImage, camera: Camera, T_cw: NDArray[np.float64]
    ) -> PlaneView:
        """A keyframe's planes, and those that it shows where others have told a step; arguments as of `observe`."""
        alive = [pair for pair in self._joining.steps() if all(instance in self._instances for instance in pair)]
        if not alive:
            return view
        samples = Samples.of(view, depth_m, camera, T_cw, self._config.mask_width_px)
        return with_known_steps(samples, alive, self._config, self._tolerance.sensor_per_m2)

    def observe(
        self, view: PlaneView, depth_m: FloatImage, camera: Camera, T_cw: NDArray[np.float64], keyframe: int
    ) -> Observation:
        """Match a keyframe's planes to the PGIs, and let them grow, begin, merge, split and end.

        depth_m: [H, W] m on the host, as the view was made from. keyframe: a number that grows from call to call.
        """
        self.version += 1
        samples = Samples.of(view, depth_m, camera, T_cw, self._config.mask_width_px)
        matching = ViewMatching(samples, self._instances, self._config, self._tolerance)
        corrected = self._match(matching, keyframe)
        seen = self._integrate(matching, keyframe)
        created, levelled = self._confirm(seen, matching)
        removed = self._weigh_contradictions(matching, seen)
        created += self._split(seen)
        merged = [*levelled, *self._overrule(matching), *self._merge(seen, samples)]
        ids = [self._id_of(owner, keyframe) for owner in matching.owner]
        shrunk = tuple(sorted({instance.id for instance in corrected if instance.id != NO_ID}))
        return Observation(keyframe, np.array(ids, np.int32), tuple(created), tuple(merged), tuple(removed), shrunk)

    @property
    def table(self) -> PlaneTable:
        """The planes as they are now, by every id that was ever given."""
        return PlaneTable.of(self, self.id_count)

    def follow(self, corrections: Poses) -> tuple[tuple[int, int], ...]:
        """Keyframes have moved in the world: p_w <- corrections[keyframe] p_w, [4, 4] each; the others stay.

        PGIs are computed again from their keyframes' views. Returns merges (kept, absorbed) of those that now coincide.
        """
        self.version += 1
        affected = [i for i in self._instances if any(k in corrections for k in i.keyframes)]
        for instance in affected:
            instance.move(corrections, self._poses)
        return tuple(self._merge(affected, None))

    def _match(self, matching: ViewMatching, keyframe: int) -> set[PlanarInstance]:
        """Give every segment its instance; new ones for those that neither overlap nor continue one that there is.

        Returns with the instances that have lost a part of their extent.
        """
        for careful in (True, False):
            for segment, instance in matching.overlapping(careful):
                self._give(matching, segment, instance, keyframe)
        corrected: set[PlanarInstance] = set()
        for segment in range(len(matching.segments)):
            if matching.owner[segment] is None:
                found = matching.continued(segment)
                if found is None:
                    found = PlanarInstance(matching.world(segment), self._config)
                    corrected |= self._part(segment, found, matching)
                self._give(matching, segment, found, keyframe)
        for pair in matching.steps():
            self._joining.step(*pair)
        return corrected | self._divide(matching)

    def _give(self, matching: ViewMatching, segment: int, instance: PlanarInstance, keyframe: int) -> None:
        matching.give(segment, instance, keyframe, self._joining.parted_from(instance))

    def _part(self, segment: int, new: PlanarInstance, matching: ViewMatching) -> set[PlanarInstance]:
        """Take from the instances that were thought to go on over a gap what lies beyond, where that parts them."""
        parted = matching.parted(segment)
        for instance in parted:
            new.support.absorb(*matching.beyond_gap(segment, instance))
            self._joining.part(instance, new)
        return set(parted)

    def _divide(self, matching: ViewMatching) -> set[PlanarInstance]:
        """Where a view shows both of two parted instances, what it shows of the one is no part of the other.

        At a step, only what it shows of the smaller one counts: else the border's noise would wear that away.
        """
        corrected = set()
        for segment, owner in enumerate(matching.owner):
            if owner is None:
                continue
            for other in self._joining.parted_from(owner):
                worn = self._joining.on_step(owner, other) and len(owner.support) > len(other.support)
                if worn or not matching.pieces(other):
                    continue
                if other.support.remove(matching.samples.footprint(segment, other.support)):
                    corrected.add(other)
        return corrected

    def _integrate(self, matching: ViewMatching, keyframe: int) -> list[PlanarInstance]:
        """Hand each instance its view; returns the instances in view, oldest first."""
        seen = [instance for instance in matching.instances if matching.pieces(instance)]
        for instance in seen:
            instance.add_view(keyframe, *matching.combined(matching.pieces(instance)), self._poses)
        self._instances = matching.instances
        return seen

    def _confirm(self, seen: list[PlanarInstance], matching: ViewMatching) -> tuple[list[int], list[tuple[int, int]]]:
        """Candidates that have become PGIs, and (kept, given up) of PGIs that are others' unevenness.

        Candidates that have become neither for too long are dropped.
        """
        created, levelled = [], []
        for instance in seen:
            levelled += self._level(instance)
            reliable = any(matching.segments[piece].reliable for piece in matching.pieces(instance))
            if instance.is_candidate and (reliable or len(instance.keyframes) >= self._needed_views(instance)):
                created.append(self._name(instance))
        for instance in self._instances:
            instance.unseen += instance not in seen
        limit = self._config.candidate_keyframes
        self._instances = [i for i in self._instances if i.id != NO_ID or i.unseen <= limit]
        return created, levelled

    def _level(self, instance: PlanarInstance) -> list[tuple[int, int]]:
        """What turns out to be a larger PGI's unevenness goes by that one's id; (kept, given up) if it had its own."""
        if instance.part_of is not None and _heir(instance) in self._instances:
            return []
        instance.part_of = next((i for i in self._instances if is_part(instance, i, self._config)), None)
        if instance.part_of is None or instance.id == NO_ID:
            return []
        given_up, instance.id = instance.id, NO_ID
        self._absorbed_by[given_up] = instance.part_of.id
        return [(instance.part_of.id, given_up)]

    def _needed_views(self, candidate: PlanarInstance) -> int:
        """Views that make a candidate a PGI: one less where how it stands speaks for it.

        What a step parts from another surface has its normal from that, which tells nothing.
        """
        measured = not self._joining.has_step(candidate)
        return self._config.confirm_views - (measured and stands_as_known(candidate, self._instances, self._config))

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
            elif len(view.shown) >= LEAST_SAMPLES:
                instance.through = 0
        ended = [i for i in self._instances if self._is_refuted(i)]
        self._instances = [i for i in self._instances if i not in ended]
        return [instance.id for instance in ended if instance.id != NO_ID]

    def _contradicts(self, view: Sight) -> bool:
        visible = view.through_count + len(view.shown)
        return visible >= LEAST_SAMPLES and view.through_share >= self._config.through_share

    def _is_refuted(self, instance: PlanarInstance) -> bool:
        """One view that sees through it is enough against a candidate."""
        limit = 1 if instance.id == NO_ID else self._config.through_keyframes
        return instance.through >= limit or len(instance.support) == 0

    def _split(self, seen: list[PlanarInstance]) -> list[int]:
        """Instances that turn out to be two surfaces become two; the ids of the new ones."""
        parts = [part for instance in seen if (part := instance.split(self._poses)) is not None]
        self._instances += parts
        return [self._name(part) for part in parts]

    def _overrule(self, matching: ViewMatching) -> list[tuple[int, int]]:
        """Let go of instances that views count to another one: that takes their ids, but not their bent planes."""
        merged: list[tuple[int, int]] = []
        for kept, bent in self._joining.overruled(matching):
            if kept in self._instances and bent in self._instances:
                merged += self._replace(bent, kept)
        return merged

    def _merge(self, touched: list[PlanarInstance], samples: Samples | None) -> list[tuple[int, int]]:
        """Make one of each pair of instances that turn out to be the same surface; (kept, absorbed) of PGIs."""
        merged: list[tuple[int, int]] = []
        while True:
            touched = [i for i in touched if i in self._instances]
            twins = self._joining.twins(touched, self._instances, samples)
            if twins is None:
                return merged
            # A PGI before a candidate, then the older one
            kept, absorbed = sorted(twins, key=lambda i: (i.id == NO_ID, i.id, i.keyframes[0]))
            kept.absorb(absorbed, self._poses)
            merged += self._replace(absorbed, kept)
            touched = [*touched, kept]

    def _replace(self, gone: PlanarInstance, kept: PlanarInstance) -> list[tuple[int, int]]:
        """An instance lives on as another one; (kept, gone) if it was a PGI."""
        gone.merged_into = kept
        self._instances = [i for i in self._instances if i is not gone]
        self._joining.replace(gone, kept)
        if gone.id == NO_ID:
            return []
        self._absorbed_by[gone.id] = kept.id
        return [(kept.id, gone.id)]

    def _name(self, instance: PlanarInstance) -> int:
        instance.id = self._next_id
        self._next_id += 1
        return instance.id

    def _id_of(self, owner: PlanarInstance | None, keyframe: int) -> int:
        """The id of a segment's instance after this keyframe's merges and splits."""
        if owner is None:
            return NO_ID
        owner = _heir(owner)
        split_off = [i.id for i in self._instances if i.split_from is owner and keyframe in i.keyframes]
        return split_off[-1] if split_off and keyframe not in owner.keyframes else owner.id


def _heir(instance: PlanarInstance) -> PlanarInstance:
    """The one under whose id an instance lives on."""
    while (heir := instance.merged_into or instance.part_of) is not None:
        instance = heir
    return instance
