"""Which scale of depth images would make something of them that rooms hold, where the given one does not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_CUSTOMARY = {1000.0: "millimetres", 5000.0: "units of the TUM benchmark", 6553.5: "units of Replica"}
_NEAREST_M, _FARTHEST_M = 0.4, 6.0  # median depth of what is filmed indoors


def other_scale(raw: NDArray[Any], units_per_metre: float) -> str:
    """A remark on depth [H, W] in a file's units, of which nothing is in range: which scale it may have; "" if none."""
    values = raw[raw > 0]
    if not len(values):
        return "; it holds no measurement at all"
    median = float(np.median(values))
    for scale, what in _CUSTOMARY.items():
        if scale != units_per_metre and _NEAREST_M <= median / scale <= _FARTHEST_M:
            metres = f"{median / scale:.2g} m"
            return f"; its median is {median:g} units: {metres} in {what}, which is dataset.depth_scale={scale:g}"
    return ""
