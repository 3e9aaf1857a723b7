"""The palette of Eq. 2: a colour for every plane id, stable for ever, and ids read back from colours."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

NO_PLANE = -1  # its colour is black
_LEVELS = 17  # of the lattice of colours, per channel: 4,913 colours before the first one repeats
_LOW, _HIGH = 0.04, 0.96  # what a sigmoid (Eq. 1) reaches without saturating
_FIRST_BLOCK = 64


def colours(ids: ArrayLike) -> NDArray[np.float32]:
    """RGB in [0, 1] of plane ids of any shape [...] -> [..., 3]; black for ids below 0.

    Each colour is the one of a lattice in the RGB cube that is farthest from black and from the colours of all smaller
    ids, so that it depends on its id alone, and any number of first ids is well separated.
    """
    ids = np.asarray(ids, np.int64)
    index = np.where(ids < 0, 0, ids % (_LEVELS**3 - 1) + 1)
    return _sequence(_block(int(index.max(initial=0)) + 1))[index]


def ids_of(observed: NDArray[np.floating], known_ids: NDArray[np.integer], margin: float = 0.05) -> NDArray[np.int32]:
    """The known id whose colour is nearest to each of the colours [N, 3] -> [N].

    -1 where black is nearer, or where another known colour (or black) is nearer than `margin` farther: undecided.
    """
    candidates = np.append(NO_PLANE, np.asarray(known_ids, np.int64)).astype(np.int32)
    squared = _squared_distances(np.asarray(observed, np.float64), colours(candidates).astype(np.float64))
    if len(candidates) == 1:
        return np.full(len(squared), NO_PLANE, np.int32)
    nearest = np.argmin(squared, axis=1)
    two = np.sqrt(np.maximum(np.partition(squared, 1, axis=1)[:, :2], 0.0))
    return np.where(two[:, 1] - two[:, 0] >= margin, candidates[nearest], NO_PLANE).astype(np.int32)


def _squared_distances(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N, M] between rows of a [N, 3] and of b [M, 3]."""
    return (a**2).sum(1)[:, None] - 2.0 * a @ b.T + (b**2).sum(1)


def _block(count: int) -> int:
    """`count` rounded up to a power of two times the first block: few different lengths are computed."""
    length = _FIRST_BLOCK
    while length < count:
        length *= 2
    return min(length, _LEVELS**3)


@lru_cache(maxsize=8)
def _sequence(count: int) -> NDArray[np.float32]:
    """[count, 3] black, then farthest points of the lattice, each from all before it; a longer one starts the same."""
    steps = np.linspace(_LOW, _HIGH, _LEVELS)
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    result = np.zeros((count, 3), np.float32)
    nearest = (lattice**2).sum(1)
    for i in range(1, count):
        chosen = lattice[np.argmax(np.round(nearest, 9))]  # rounded: equal distances are a tie, the first one wins
        result[i] = chosen
        nearest = np.minimum(nearest, ((lattice - chosen) ** 2).sum(1))
    return result
