"""What a recording's clock counts in: seconds, or the nanoseconds, microseconds or milliseconds of other programs."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

_UNITS = {1e9: "nanoseconds", 1e6: "microseconds", 1e3: "milliseconds"}
_LEAST_SPACING = 500.0  # between frames, in what the clock counts: nobody films a frame every eight minutes
_SLOWEST_S = 2.0  # between frames of what is filmed
_EPOCHS = ((3e16, 1e9), (3e13, 1e6), (3e10, 1e3))  # times since 1970: of this century in seconds, these are far ahead


def ticks_per_second(times: ArrayLike) -> float:
    """By how much to divide times [N], increasing, for seconds: 1.0 where they are, or where nothing says they aren't.

    Image numbers, one apart, stay as they are.
    """
    values = np.asarray(times, np.float64)
    values = values[np.isfinite(values)]
    gaps = np.diff(np.unique(values))
    spacing = float(np.median(gaps)) if len(gaps) else 0.0
    if spacing >= _LEAST_SPACING:
        return next((unit for unit in (1e6, 1e9) if spacing / unit <= _SLOWEST_S), 1.0)
    earliest = float(values.min()) if len(values) else 0.0
    return next((unit for least, unit in _EPOCHS if earliest > least), 1.0)


def unit_name(ticks: float) -> str:
    """What a clock of so many ticks a second counts in."""
    return _UNITS.get(ticks, "seconds")
