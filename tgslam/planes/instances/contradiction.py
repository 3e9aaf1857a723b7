"""Instances that a keyframe sees through, and which of them end for it."""

from __future__ import annotations

from collections.abc import Sequence

from tgslam.config.plane_settings import LifetimeSettings
from tgslam.planes.instances.instance import NO_ID, PlanarInstance
from tgslam.planes.instances.matching import LEAST_SAMPLES, ViewMatching
from tgslam.planes.instances.sight import Sight

_SUSPECT_PLANES = 3  # so many contradicted at once, and more than confirmed: the pose is wrong, not the planes


def refuted(
    instances: Sequence[PlanarInstance],
    matching: ViewMatching,
    seen: Sequence[PlanarInstance],
    config: LifetimeSettings,
) -> list[PlanarInstance]:
    """Take back what the view sees through; those of the instances of which nothing is left, or no view speaks for.

    seen: the instances that the view shows.
    """
    sights = [(matching.instances[i], s) for i, s in matching.sights.items()]
    against = [instance for instance, s in sights if instance not in seen and _contradicts(s, config)]
    if len(against) >= max(_SUSPECT_PLANES, len(seen) + 1):
        return []
    for instance, view in sights:
        instance.support.weaken(view.through_cells)
        if instance in against:
            instance.record.through += 1
        elif len(view.shown) >= LEAST_SAMPLES:
            instance.record.through = 0
    return [instance for instance in instances if _is_refuted(instance, config)]


def _contradicts(view: Sight, config: LifetimeSettings) -> bool:
    visible = view.through_count + len(view.shown)
    return visible >= LEAST_SAMPLES and view.through_share >= config.through_share


def _is_refuted(instance: PlanarInstance, config: LifetimeSettings) -> bool:
    """One view that sees through it is enough against a candidate."""
    limit = 1 if instance.id == NO_ID else config.through_keyframes
    return instance.record.through >= limit or len(instance.support) == 0
