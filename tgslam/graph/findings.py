"""What a search for closures gives: of structure and visual ones alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.relative_motion import Measurement

# T_ji [4, 4] of keyframes i, j as the graph has it, and its covariance [6, 6]: `PoseGraph.relative`
Relative = Callable[[int, int], tuple[NDArray[np.float64], NDArray[np.float64]]]


@dataclass(frozen=True)
class Closure:
    """A motion from an earlier keyframe that was not measured by tracking."""

    earlier: int
    shared: tuple[int, ...]  # PGIs through which it was measured, ascending; empty = visually
    measured: Measurement


@dataclass(frozen=True)
class Findings:
    """What came of a keyframe's candidates."""

    closures: tuple[Closure, ...]
    inconsistent: int  # whose evidence does not agree on a motion
    gated: int  # that do not agree with the graph
