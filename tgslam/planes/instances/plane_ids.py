"""The ids of PGIs: how they are given, and what becomes of them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from tgslam.planes.instances.instance import NO_ID, PlanarInstance


class PlaneIds:
    """Ids count up from 0 and are never used again."""

    def __init__(self) -> None:
        self._next: list[int] = []  # by id: the one that has absorbed it, or itself

    def give(self, instance: PlanarInstance) -> int:
        """An instance is a PGI from now on, under this id."""
        instance.id = len(self._next)
        self._next.append(instance.id)
        return instance.id

    def pass_on(self, gone: int, kept: int) -> tuple[int, int]:
        """A PGI lives on under the id of another one. Returns with (kept, gone)."""
        self._next[gone] = kept
        return kept, gone

    def resolved(self, alive: Iterable[int]) -> NDArray[np.int32]:
        """[P] the id under which each id lives on, out of those that are alive; -1 = removed."""
        last = np.array(self._next, np.int32)
        while (last[last] != last).any():
            last = last[last]
        return np.where(np.isin(last, np.array(list(alive), np.int32)), last, np.int32(NO_ID))
