"""What keyframes have said for and against an instance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tgslam.planes.instances.instance import PlanarInstance


@dataclass
class TrackRecord:
    """Counts of keyframes."""

    unseen: int = 0  # since it was last seen
    through: int = 0  # one after the other, that see through it
    taken: int = 0  # one after the other, that have counted what they show of it to the same instance
    taken_by: PlanarInstance | None = None  # that instance
    seen_past: bool = False  # views have shown that what stands before a gap in it does not part it

    def seen(self) -> None:
        """A keyframe shows it."""
        self.unseen = self.through = 0

    def counted_to(self, owner: PlanarInstance | None) -> None:
        """A keyframe counts what it shows of it to that instance, or to none."""
        self.taken = self.taken + 1 if owner is self.taken_by else 1
        self.taken_by = owner
