"""What leaves the system of its planes: plain data."""

from __future__ import annotations

from tgslam.planes.instances.instance import PlanarInstance
from tgslam.planes.instances.registry import PlaneRegistry
from tgslam.types import Plane


def planes_of(registry: PlaneRegistry) -> tuple[Plane, ...]:
    """The PGIs of a registry as they are now, by id, ascending; candidates are left out.

    Keyframes are the numbers that the registry was told.
    """
    return tuple(_plane(instance) for instance in registry.instances.values())


def _plane(instance: PlanarInstance) -> Plane:
    red, green, blue = (float(value) for value in instance.colour)
    return Plane(
        id=instance.id,
        normal_w=instance.normal_w.copy(),
        offset_m=instance.offset_m,
        centroid_w=instance.centroid_w.copy(),
        covariance=instance.covariance.copy(),
        colour=(red, green, blue),
        polygons_w=tuple(instance.polygons_w()),
        area_m2=instance.area_m2,
        inlier_rms_m=instance.rms_m,
        keyframes=tuple(instance.keyframes),
    )
