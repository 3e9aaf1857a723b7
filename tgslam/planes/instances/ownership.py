"""Gives each segment of a keyframe to the instance that it shows, and each instance what is its own of the extent."""

from __future__ import annotations

from tgslam.config.plane_settings import PlanesConfig
from tgslam.planes.instances.instance import PlanarInstance
from tgslam.planes.instances.joining import Joining
from tgslam.planes.instances.matching import ViewMatching


def give_segments(matching: ViewMatching, joining: Joining, keyframe: int, config: PlanesConfig) -> set[PlanarInstance]:
    """Give every segment its instance; new ones for those that neither overlap nor continue one that there is.

    Returns with the instances that have lost a part of their extent.
    """
    for careful in (True, False):
        for segment, instance in matching.overlapping(careful):
            matching.give(segment, instance, keyframe, joining.parted_from(instance))
    corrected: set[PlanarInstance] = set()
    for segment in range(len(matching.owner)):
        if matching.owner[segment] is None:
            found = matching.continued(segment)
            if found is None:
                found = PlanarInstance(matching.world(segment), config)
                corrected |= _part(segment, found, matching, joining)
            matching.give(segment, found, keyframe, joining.parted_from(found))
    for pair in matching.steps():
        joining.step(*pair)
    return corrected | _divide(matching, joining)


def _part(segment: int, new: PlanarInstance, matching: ViewMatching, joining: Joining) -> set[PlanarInstance]:
    """Take from the instances that were thought to go on over a gap what lies beyond, where that parts them."""
    parted = matching.parted(segment)
    for instance in parted:
        new.support.absorb(*matching.beyond_gap(segment, instance))
        joining.part(instance, new)
    return set(parted)


def _divide(matching: ViewMatching, joining: Joining) -> set[PlanarInstance]:
    """Where a view shows both of two parted instances, what it shows of the one is no part of the other.

    At a step, only what it shows of the smaller one counts: else the border's noise would wear that away.
    """
    corrected = set()
    for segment, owner in enumerate(matching.owner):
        if owner is None:
            continue
        for other in joining.parted_from(owner):
            worn = joining.on_step(owner, other) and len(owner.support) > len(other.support)
            if worn or not matching.pieces(other):
                continue
            if other.support.remove(matching.samples.footprint(segment, other.support)):
                corrected.add(other)
    return corrected
