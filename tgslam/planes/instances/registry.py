"""The set of Planar Gaussian Instances: how they begin, grow, merge, split and end (section 3.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.plane_settings import PlanesConfig
from tgslam.planes.estimate import PlaneEstimate
from tgslam.planes.instances.contradiction import refuted
from tgslam.planes.instances.directions import stands_as_known
from tgslam.planes.instances.instance import NO_ID, PlanarInstance
from tgslam.planes.instances.joining import Joining
from tgslam.planes.instances.known_steps import with_known_steps
from tgslam.planes.instances.matching import ViewMatching
from tgslam.planes.instances.ownership import give_segments
from tgslam.planes.instances.plane_ids import PlaneIds
from tgslam.planes.instances.plane_table import PlaneTable
from tgslam.planes.instances.sight import Samples, Tolerance
from tgslam.planes.instances.unevenness import is_part
from tgslam.planes.instances.views import Poses
from tgslam.planes.segment import PlaneView
from tgslam.types import FloatImage


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
    """All PGIs of a run.

    A reliable segment that matches nothing is a PGI at once. An ambiguous one is a candidate: it becomes a PGI, with
    its first keyframe, when further views or a reliable segment confirm it, and is dropped when they do not. What is
    but the unevenness of a larger PGI goes by that one's id, and is kept so that later views find it again.
    """

    def __init__(self, config: PlanesConfig, noise: SensorNoise, poses: Poses) -> None:
        """noise: the depth sensor's. poses: T_wc [4, 4] of each keyframe, now and later; only read here."""
        self.version = 0  # grows whenever something may have changed
        self._config, self._poses = config, poses
        self._tolerance = Tolerance.of(config, noise)
        self._instances: list[PlanarInstance] = []  # candidates included, oldest first
        self._ids = PlaneIds()
        self._joining = Joining(config, self._tolerance)
        self._table: PlaneTable | None = None  # of this version, once somebody has asked for it

    @property
    def instances(self) -> dict[int, PlanarInstance]:
        """The PGIs by id, ascending. Candidates are not among them."""
        return {i.id: i for i in sorted(self._instances, key=lambda instance: instance.id) if i.id != NO_ID}

    @property
    def table(self) -> PlaneTable:
        """The PGIs as they are now, by every id that was ever given."""
        if self._table is None:
            instances = self.instances
            self._table = PlaneTable.of(instances, self._ids.resolved(instances))
        return self._table

    @property
    def candidate_count(self) -> int:
        """Ambiguous surfaces that wait for further views."""
        return sum(instance.is_candidate for instance in self._instances)

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
        samples = self._samples(view, depth_m, camera, T_cw)
        return with_known_steps(samples, alive, self._config, self._tolerance.noise)

    def observe(
        self, view: PlaneView, depth_m: FloatImage, camera: Camera, T_cw: NDArray[np.float64], keyframe: int
    ) -> Observation:
        """Match a keyframe's planes to the PGIs, and let them grow, begin, merge, split and end.

        depth_m: [H, W] m on the host, as the view was made from. keyframe: a number that grows from call to call, whose
        pose has been put to the others before.
        """
        self._changed()
        samples = self._samples(view, depth_m, camera, T_cw)
        matching = ViewMatching(samples, self._instances, self._config, self._tolerance)
        corrected = give_segments(matching, self._joining, keyframe, self._config)
        seen = self._integrate(matching, keyframe)
        created, levelled = self._confirm(seen, matching)
        removed = self._end(matching, seen)
        created += self._split(seen)
        merged = [*levelled, *self._overrule(matching), *self._merge(seen, samples)]
        ids = [self._id_of(owner, keyframe) for owner in matching.owner]
        shrunk = tuple(sorted({instance.id for instance in corrected if instance.id != NO_ID}))
        return Observation(keyframe, np.array(ids, np.int32), tuple(created), tuple(merged), tuple(removed), shrunk)

    def follow(self, motions: Poses) -> tuple[tuple[int, int], ...]:
        """Keyframes have moved in the world, p_w <- motions[keyframe] p_w, and their poses have been changed so.

        PGIs are computed again from their keyframes' views. Returns merges (kept, absorbed) of those that now coincide.
        """
        self._changed()
        affected = [i for i in self._instances if any(k in motions for k in i.keyframes)]
        for instance in affected:
            instance.follow(motions, self._poses)
        return tuple(self._merge(affected, None))

    def _changed(self) -> None:
        self.version += 1
        self._table = None

    def _samples(self, view: PlaneView, depth_m: FloatImage, camera: Camera, T_cw: NDArray[np.float64]) -> Samples:
        return Samples.of(view, depth_m, camera, T_cw, self._config.expert.association.mask_width_px)

    def _integrate(self, matching: ViewMatching, keyframe: int) -> list[PlanarInstance]:
        """Hand each instance its view; returns the instances in view, oldest first."""
        seen = [instance for instance in matching.instances if matching.pieces(instance)]
        for instance in seen:
            instance.add_view(keyframe, *matching.planes.combined(matching.pieces(instance)), self._poses)
        self._instances = matching.instances
        return seen

    def _confirm(self, seen: list[PlanarInstance], matching: ViewMatching) -> tuple[list[int], list[tuple[int, int]]]:
        """Candidates that have become PGIs, and (kept, given up) of PGIs that are others' unevenness.

        Candidates that have become neither for too long are dropped.
        """
        created, levelled = [], []
        for instance in seen:
            levelled += self._level(instance)
            reliable = matching.planes.any_reliable(matching.pieces(instance))
            if instance.is_candidate and (reliable or len(instance.keyframes) >= self._needed_views(instance)):
                created.append(self._ids.give(instance))
        for instance in self._instances:
            instance.record.unseen += instance not in seen
        limit = self._config.expert.lifetime.candidate_keyframes
        self._instances = [i for i in self._instances if i.id != NO_ID or i.record.unseen <= limit]
        return created, levelled

    def _level(self, instance: PlanarInstance) -> list[tuple[int, int]]:
        """What turns out to be a larger PGI's unevenness goes by that one's id; (kept, given up) if it had its own."""
        if instance.lineage.part_of is not None and instance.heir in self._instances:
            return []
        limits = self._config.expert.segmentation
        whole = next((i for i in self._instances if is_part(instance, i, limits)), None)
        instance.lineage.part_of = whole
        if whole is None or instance.id == NO_ID:
            return []
        given_up, instance.id = instance.id, NO_ID
        return [self._ids.pass_on(given_up, whole.id)]

    def _needed_views(self, candidate: PlanarInstance) -> int:
        """Views that make a candidate a PGI: one less where how it stands speaks for it.

        What a step parts from another surface has its normal from that, which tells nothing.
        """
        measured = not self._joining.has_step(candidate)
        return self._config.confirm_views - (measured and stands_as_known(candidate, self._instances, self._config))

    def _end(self, matching: ViewMatching, seen: list[PlanarInstance]) -> list[int]:
        """Let go of instances that the view refutes; the ids of those that were PGIs."""
        ended = refuted(self._instances, matching, seen, self._config.expert.lifetime)
        self._instances = [i for i in self._instances if i not in ended]
        return [instance.id for instance in ended if instance.id != NO_ID]

    def _split(self, seen: list[PlanarInstance]) -> list[int]:
        """Instances that turn out to be two surfaces become two; the ids of the new ones."""
        parts = [part for instance in seen if (part := instance.split(self._poses)) is not None]
        self._instances += parts
        return [self._ids.give(part) for part in parts]

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
        gone.lineage.merged_into = kept
        self._instances = [i for i in self._instances if i is not gone]
        self._joining.replace(gone, kept)
        return [] if gone.id == NO_ID else [self._ids.pass_on(gone.id, kept.id)]

    def _id_of(self, owner: PlanarInstance | None, keyframe: int) -> int:
        """The id of a segment's instance after this keyframe's merges and splits."""
        if owner is None:
            return NO_ID
        owner = owner.heir
        split_off = [i.id for i in self._instances if i.split_from is owner and keyframe in i.keyframes]
        return split_off[-1] if split_off and keyframe not in owner.keyframes else owner.id
