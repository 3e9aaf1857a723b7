"""Pairing two series of timestamps: colour with depth images, estimated with true poses."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import ArrayLike, NDArray

_log = logging.getLogger(__name__)
# Units of clocks, s; the times since 1970 that pass a value are in them, and so are gaps between frames that pass one
_CLOCKS = (
    ("nanoseconds", 1e-9, 1e17, 5e5),
    ("microseconds", 1e-6, 1e14, 500.0),
    ("milliseconds", 1e-3, 1e11, np.inf),
)


def seconds_in(times: ArrayLike, name: str) -> float:
    """Seconds in the unit of the times [N] of frames or poses. One that is no second is logged."""
    values = np.unique(np.asarray(times, np.float64))
    median = float(np.median(values)) if values.size else 0.0
    gap = float(np.median(np.diff(values))) if values.size > 1 else 0.0
    for unit, seconds, least, least_gap in _CLOCKS:
        if median > least or gap > least_gap:
            _log.warning("%s: its times are in %s, and are read so", name, unit)
            return seconds
    return 1.0


def associate_times(
    first_s: ArrayLike, second_s: ArrayLike, tolerance_s: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pair sorted times [N] s with sorted times [M] s, one to one, closest pairs first, at most `tolerance_s` apart.

    Returns the indices of the pairs into both series, two arrays [K] in the order of the first series. Pairs with the
    same gap are settled in favour of the earlier one, so the result does not depend on rounding of the search.
    """
    first = np.asarray(first_s, np.float64)
    second = np.asarray(second_s, np.float64)
    # a nanosecond of slack: decimal times near 1e9 s are not exact in float64
    reach = tolerance_s + 1e-9 + 4 * np.spacing(np.abs(first).max(initial=0.0))
    low = np.searchsorted(second, first - reach, side="left")
    counts = np.searchsorted(second, first + reach, side="right") - low
    i = np.repeat(np.arange(len(first)), counts)
    j = np.arange(len(i)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(low, counts)
    order = np.lexsort((j, i, np.abs(first[i] - second[j])))

    partner = np.full(len(first), -1, np.intp)
    taken = np.zeros(len(second), bool)
    for k in order:
        if partner[i[k]] < 0 and not taken[j[k]]:
            partner[i[k]] = j[k]
            taken[j[k]] = True
    paired = np.flatnonzero(partner >= 0)
    return paired, partner[paired]
