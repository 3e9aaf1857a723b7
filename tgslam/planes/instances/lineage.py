"""Where an instance comes from, and as what it lives on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tgslam.planes.instances.instance import PlanarInstance


@dataclass
class Lineage:
    """Other instances that one has to do with."""

    split_from: PlanarInstance | None = None  # of which it was taken for a part
    merged_into: PlanarInstance | None = None  # which has all that it had
    part_of: PlanarInstance | None = None  # whose unevenness it is: then it goes by that one's id
    revision: int = 0  # how often it got or lost views otherwise than by being seen

    @property
    def heir(self) -> PlanarInstance | None:
        """The next one under whose id it lives on."""
        return self.merged_into or self.part_of
