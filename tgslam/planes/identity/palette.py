"""The palette of Eq. 2: a colour for every plane id, stable for ever."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

NO_PLANE = -1  # its colour is black
_LEVELS = 17  # of the lattice of colours, per channel: 4,913 colours before the first one repeats
LEAST, MOST = 0.04, 0.96  # what a sigmoid (Eq. 1) reaches without saturating
_FIRST_BLOCK = 64  # colours that are computed at first: more than most scenes have planes


def colours(ids: ArrayLike) -> NDArray[np.float32]:
    """RGB in [0, 1] of plane ids of any shape [...] -> [..., 3]; black for ids below 0.

    Each colour is the one of a lattice in the RGB cube that is farthest from black and from the colours of all smaller
    ids, so that it depends on its id alone, and any number of first ids is well separated.
    """
    ids = np.asarray(ids, np.int64)
    index = np.where(ids < 0, 0, ids % (_LEVELS**3 - 1) + 1)
    return _sequence(_block(int(index.max(initial=0)) + 1))[index]


def _block(count: int) -> int:
    """`count` rounded up to a power of two times the first block: few different lengths are computed."""
    length = _FIRST_BLOCK
    while length < count:
        length *= 2
    return min(length, _LEVELS**3)


@lru_cache(maxsize=8)
def _sequence(count: int) -> NDArray[np.float32]:
    """[count, 3] black, then farthest points of the lattice, each from all before it; a longer one starts the same."""
    steps = np.linspace(LEAST, MOST, _LEVELS)
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    result = np.zeros((count, 3), np.float32)
    nearest = (lattice**2).sum(1)
    for i in range(1, count):
        chosen = lattice[np.argmax(np.round(nearest, 9))]  # rounded: equal distances are a tie, the first one wins
        result[i] = chosen
        nearest = np.minimum(nearest, ((lattice - chosen) ** 2).sum(1))
    return result
