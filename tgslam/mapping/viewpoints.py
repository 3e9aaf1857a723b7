"""Sparse Global Viewpoints (section 3.4): earlier keyframes that hold still while the window is refined."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

_SHARED_PLANES = 2


class Viewpoints:
    """Chooses a few earlier keyframes for a window by the paper's rules, best first.

    1. Keyframes that a structure closure ties to the window, then those that one ties to any other keyframe.
    2. Keyframes that share two or more PGIs with the window.
    3. The most connected ones in the pose graph, which without closures are all alike.

    Of those that a rule cannot tell apart some are drawn, so that in time all take their turn.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._closures: set[tuple[int, int]] = set()

    def link(self, first: int, second: int) -> None:
        """A structure closure ties two keyframes together."""
        self._closures.add((min(first, second), max(first, second)))

    def choose(self, count: int, window: Sequence[int], seen_by: Mapping[int, Iterable[int]]) -> list[int]:
        """At most `count` keyframes before those of the window; seen_by: the keyframes that saw each PGI."""
        first = min(window)
        degree = Counter(keyframe for pair in self._closures for keyframe in pair)
        tied = {a for a, b in self._closures if b in window} | {b for a, b in self._closures if a in window}
        shared = _shared_planes(set(window), seen_by)

        def rank(keyframe: int) -> tuple[bool, bool, bool, int]:
            return (keyframe in tied, keyframe in degree, shared[keyframe] >= _SHARED_PLANES, degree[keyframe])

        order = self._rng.permutation(first).tolist()
        return sorted(sorted(order, key=rank, reverse=True)[:count])


def _shared_planes(window: set[int], seen_by: Mapping[int, Iterable[int]]) -> Counter[int]:
    """How many of the window's PGIs each keyframe saw."""
    counts: Counter[int] = Counter()
    for keyframes in seen_by.values():
        if not window.isdisjoint(keyframes):
            counts.update(set(keyframes))
    return counts
