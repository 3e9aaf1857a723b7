"""Pairing two series of timestamps: colour with depth images, estimated with true poses."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tgslam.files.clock import ticks_per_second, unit_name

_log = logging.getLogger(__name__)


def seconds_in(times: ArrayLike, name: str) -> float:
    """Seconds in the unit of the times [N] of frames. One that is no second is logged."""
    ticks = ticks_per_second(times)
    if ticks != 1.0:
        _log.warning("%s: its times are in %s, and are read so", name, unit_name(ticks))
    return 1.0 / ticks


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
