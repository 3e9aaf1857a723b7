"""Which instances are one surface: coplanar, and joined where they meet, behind what hides the gap, or out of view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam.config.plane_settings import PlanesConfig
from tgslam.planes.estimate import offset_sigmas, stacked
from tgslam.planes.instances.association import gate
from tgslam.planes.instances.gaps import Gap, adjoins, gap_between, shortest_gap
from tgslam.planes.instances.instance import NO_ID, PlanarInstance
from tgslam.planes.instances.matching import LEAST_SAMPLES, WELL, ViewMatching, coplanar_in_views
from tgslam.planes.instances.sight import Samples, Tolerance

_MOST = 0.5  # of an extent, that lies in another one
_TAKEN_SHARE = 0.8  # of what a view shows of a surface, that it counts to another one
_BEHIND_SHARE = 0.02  # of all surfaces, that errors may put behind a plane that bounds the scene

Pair = tuple[PlanarInstance, PlanarInstance]


class Joining:
    """Finds pairs of instances that are the same surface, and remembers which ones never are."""

    def __init__(self, config: PlanesConfig, tolerance: Tolerance) -> None:
        self._config, self._tolerance = config, tolerance
        self._gate_sigmas, self._gaps = config.expert.association.gate_sigmas, config.expert.gaps
        # Coplanar pairs between which a view looks through, in the order in which they were found: that of a set would
        # be by address, and differ from run to run
        self._apart: dict[frozenset[PlanarInstance], None] = {}
        # Those of them of which one stands a little before the other
        self._steps: dict[frozenset[PlanarInstance], None] = {}
        # Those of them that only what stands in the gap parts: by keyframe that shows the gap, whether it is filled
        self._filled: dict[frozenset[PlanarInstance], dict[int, bool]] = {}

    def part(self, a: PlanarInstance, b: PlanarInstance) -> None:
        """A gap parts two instances in a view, for good."""
        self._apart[frozenset((a, b))] = None
        self._filled.pop(frozenset((a, b)), None)

    def step(self, a: PlanarInstance, b: PlanarInstance) -> None:
        """A step parts two instances in a view."""
        self.part(a, b)
        self._steps[frozenset((a, b))] = None

    def on_step(self, a: PlanarInstance, b: PlanarInstance) -> bool:
        """Whether a step has parted two instances in a view."""
        return frozenset((a, b)) in self._steps

    def steps(self) -> list[Pair]:
        """(smaller, larger) instances that a step has parted in a view, in the order in which they were."""
        pairs = [_by_extent(*pair) for pair in self._steps]  # of equals, a set's order would tell them apart
        return [(small, large) for large, small in pairs if len(small.support) < len(large.support)]

    def has_step(self, instance: PlanarInstance) -> bool:
        """Whether a step has parted an instance from any other one in a view."""
        return any(instance in pair for pair in self._steps)

    def parted_from(self, instance: PlanarInstance) -> list[PlanarInstance]:
        """The instances that a view has parted from one."""
        return [other for pair in self._apart if instance in pair for other in pair if other is not instance]

    def replace(self, absorbed: PlanarInstance, kept: PlanarInstance) -> None:
        """What parts one instance from others parts the one that has absorbed it from them."""
        renamed = {pair: frozenset(kept if i is absorbed else i for i in pair) for pair in self._apart}
        sure = {renamed[pair] for pair in self._apart if pair not in self._filled}
        filled = {renamed[pair]: looks for pair, looks in self._filled.items() if renamed[pair] not in sure}
        self._apart = {pair: None for pair in renamed.values() if len(pair) == 2}
        self._steps = {renamed[pair]: None for pair in self._steps if renamed[pair] in self._apart}
        self._filled = {pair: looks for pair, looks in filled.items() if pair in self._apart}

    def twins(
        self, touched: Sequence[PlanarInstance], everything: Sequence[PlanarInstance], samples: Samples | None
    ) -> Pair | None:
        """An instance out of `touched`, and another one, that are the same surface. samples: of the latest view."""
        if not touched:
            return None
        error = self._config.expert.uncertainty
        ours = stacked([i.plane for i in touched])[:, None]
        theirs = stacked([i.plane for i in everything])[None].widened(error.pose_sigma_rad, error.pose_sigma_m)
        origin = np.zeros(3)  # decides on offset ratios only, which are not used here
        forth, back = (gate(*pair, origin, self._config) for pair in ((theirs, ours), (ours, theirs)))
        sigmas = np.maximum(forth.deviation_sigmas, back.deviation_sigmas)
        refused: set[frozenset[PlanarInstance]] = set()  # pairs that come again the other way round
        for i, j in np.argwhere(forth.admitted & back.admitted):
            a, b = touched[i], everything[j]
            pair = frozenset((a, b))
            if a is b or pair in refused:
                continue
            in_views = coplanar_in_views(a, b)
            if in_views is None or in_views <= self._gate_sigmas:
                bounding = self._bounds(a, b, everything)
                coplanar = in_views is not None or self._coplanar(a, b, float(sigmas[i, j]), bounding)
                if coplanar and self._joined(a, b, bounding, samples):
                    return a, b
            refused.add(pair)
        return None

    def _coplanar(self, a: PlanarInstance, b: PlanarInstance, sigmas: float, bounding: bool) -> bool:
        """Two that no view shows both, and which deviate by `sigmas` in the world: by at most half the gate unless they
        bound the scene, or the extent of one lies for the most part in that of the other.
        """
        if bounding or sigmas <= WELL * self._gate_sigmas:
            return True
        large, cells = _on_larger(a, b)
        return float(np.mean(large.support.holds(cells))) > _MOST

    def _joined(self, a: PlanarInstance, b: PlanarInstance, bounding: bool, samples: Samples | None) -> bool:
        """Whether two coplanar instances adjoin, or have a gap that is hidden or, between large surfaces, out of view.

        Floors, walls and ceilings go on behind things and where no view has looked, those that bound the scene however
        far; table tops are smaller. A gap that has parted two in any view does so for good but where large ones touch,
        as walls do over a door, or where most views show that nothing stands in it.
        """
        large, cells = _on_larger(a, b)
        longest_m = np.inf if bounding else self._gaps.bridge_m
        ways = shortest_gap(large.support, cells, longest_m)
        gap = Gap(False, False, False)
        if ways is not None and samples is not None:
            gap = gap_between(samples, ways, large.plane, self._tolerance, self._gaps.close_before_m)
        self._look(a, b, gap)
        if gap.parts(max(a.area_m2, b.area_m2), self._gaps):
            return False
        if frozenset((a, b)) in self._apart:
            touching = adjoins(large.support.near(cells, 0.0))
            return touching and min(a.area_m2, b.area_m2) >= self._gaps.across_area_m2
        if bounding or adjoins(large.support.near(cells, self._gaps.max_gap_m)):
            return True
        if ways is None or samples is None:
            return False
        return gap.hidden or min(a.area_m2, b.area_m2) >= self._gaps.bridge_area_m2

    def _look(self, a: PlanarInstance, b: PlanarInstance, gap: Gap) -> None:
        """Remember whether a gap parts two instances in the latest view.

        What is seen through it does for good. What stands in it hides which they are: it parts them as long as half
        of the views or more show it: in fewer, it is noise.
        """
        pair, keyframe = frozenset((a, b)), max(a.keyframes[-1], b.keyframes[-1])
        filled = not gap.open and gap.parts(max(a.area_m2, b.area_m2), self._gaps)
        if gap.open:
            self.part(a, b)
        elif filled and pair not in self._apart:
            self._apart[pair], self._filled[pair] = None, {keyframe: True}
        elif pair in self._filled and (filled or gap.hidden):
            looks = self._filled[pair]
            looks[keyframe] = filled
            if len(looks) >= self._config.confirm_views and 2 * sum(looks.values()) < len(looks):
                del self._apart[pair], self._filled[pair]
                a.record.seen_past = b.record.seen_past = True

    def _bounds(self, a: PlanarInstance, b: PlanarInstance, everything: Sequence[PlanarInstance]) -> bool:
        """Whether a pair, one of it large, has everything in front of it: floors, walls and ceilings have, which is
        why parts of them are the same surface even when all between them is yet to be seen.
        """
        large, _ = _by_extent(a, b)
        least_m2 = self._gaps.bridge_area_m2
        if large.area_m2 < least_m2:
            return False
        behind_m2 = other_m2 = 0.0
        for other in everything:
            if other is not a and other is not b and other.id != NO_ID:
                heights_m = large.plane.heights_m(other.support.centres(other.support.cells()[0]))
                behind_m2 += float(np.mean(heights_m < -self._config.expert.association.max_distance_m)) * other.area_m2
                other_m2 += other.area_m2
        return other_m2 >= least_m2 and behind_m2 <= _BEHIND_SHARE * other_m2

    def overruled(self, matching: ViewMatching) -> list[Pair]:
        """(larger, smaller) instances where view after view counts to the larger one most that it shows of the smaller.

        Then the smaller one was a part of the larger one that a view at a bad angle or from afar has bent.
        """
        found, most = [], self._config.expert.lifetime.through_keyframes
        for index, view in matching.sights.items():
            instance = matching.instances[index]
            if len(view.shown) < LEAST_SAMPLES:
                continue
            owner = self._taker(matching, view.shown)
            instance.record.counted_to(owner)
            if owner is None or owner is instance:
                continue
            if instance.record.taken >= most and self._covers(owner, instance):
                found.append((owner, instance))
        return found

    @staticmethod
    def _taker(matching: ViewMatching, shown: NDArray[np.int64]) -> PlanarInstance | None:
        """The instance to which a view counts nearly all of these samples; None without one."""
        labels = matching.samples.label[shown]
        owners: dict[PlanarInstance, int] = {}
        for label, count in zip(*np.unique(labels[labels >= 0], return_counts=True), strict=True):
            if (owner := matching.owner[int(label)]) is not None:
                owners[owner] = owners.get(owner, 0) + int(count)
        best = max(owners, key=lambda owner: owners[owner], default=None)
        return best if best is not None and owners[best] >= _TAKEN_SHARE * len(shown) else None

    def _covers(self, large: PlanarInstance, small: PlanarInstance) -> bool:
        """Whether an instance is larger, and its plane goes through the middle of the smaller one."""
        if large.id == NO_ID or len(large.support) < len(small.support):
            return False
        return float(offset_sigmas(small.plane, large.plane)) <= self._gate_sigmas


def _by_extent(a: PlanarInstance, b: PlanarInstance) -> Pair:
    """(larger, smaller)."""
    small, large = sorted((a, b), key=lambda instance: len(instance.support))
    return large, small


def _on_larger(a: PlanarInstance, b: PlanarInstance) -> tuple[PlanarInstance, NDArray[np.int64]]:
    """The one of larger extent, and the cells [N, 2] of its grid over which the extent of the other lies."""
    large, small = _by_extent(a, b)
    return large, np.unique(large.support.cells_of(small.support.centres(small.support.cells()[0])), axis=0)
