"""What a solver says of a frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tgslam.types import Exposure


@dataclass(frozen=True)
class TrackingResult:
    """A frame's pose with what is known about it."""

    T_cw: NDArray[np.float64]  # [4, 4]
    exposure: Exposure
    information: NDArray[np.float64]  # [6, 6] of the left perturbation (rotation rad, translation m) of T_cw
    lost: bool
    message: str = ""  # the evidence, where lost
    measures: dict[str, float] = field(default_factory=dict)  # for the log
    begins: bool = False  # a new piece of the map: of where the old ones are from here, nothing is known
