"""Which plane each pixel of a keyframe shows, in a byte a pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NO_PLANE = -1
_FEW = 256  # different ids that a byte can tell


@dataclass(frozen=True)
class PlaneLabels:
    """An image of plane ids, as places in a list of those that it names."""

    ids: NDArray[np.int32]  # [K] ascending; -1 = on no plane
    places: NDArray[np.uint8] | NDArray[np.uint16]  # [H, W] index into ids

    @classmethod
    def of(cls, image: NDArray[np.integer]) -> PlaneLabels:
        """Of ids [H, W], -1 = on no plane."""
        known = np.flatnonzero(np.bincount(image.ravel() + 1)) - 1
        place = np.zeros(int(known.max(initial=NO_PLANE)) + 2, np.uint8 if len(known) <= _FEW else np.uint16)
        place[known + 1] = np.arange(len(known))
        return cls(known.astype(np.int32), place[image + 1])

    def image(self) -> NDArray[np.int32]:
        """[H, W]."""
        return self.ids[self.places]

    def pixels(self, plane_id: int) -> int:
        """How many show that plane."""
        place = int(np.searchsorted(self.ids, plane_id))
        named = place < len(self.ids) and self.ids[place] == plane_id
        return int(np.count_nonzero(self.places == place)) if named else 0
