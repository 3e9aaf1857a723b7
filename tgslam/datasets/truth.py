"""What is known of a scene besides the camera's poses; measuring may see it, the system never does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class SceneTruth(Protocol):
    """The true planes and surfaces, in the world of the ground-truth trajectory."""

    def labels(self, index: int) -> NDArray[np.int32]:
        """Plane label [H, W] of each pixel of frame number `index`, an index into `planes`; -1 = no plane."""

    def planes(self) -> NDArray[np.float64]:
        """[P, 4] unit normal out of the solid, and offset in m: n . x + d = 0."""

    def seen_areas_m2(self, index: int) -> NDArray[np.float64]:
        """[P] of the parts of their faces that frame number `index` shows."""

    def surface_distance_m(self, points_w: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N] from points [N, 3] m to the nearest surface."""


class TruthOfFrames:
    """The truth of a sequence of which only some frames are used: frame number i is `indices[i]` of the original."""

    def __init__(self, truth: SceneTruth, indices: Sequence[int]) -> None:
        self._truth, self._indices = truth, indices

    def labels(self, index: int) -> NDArray[np.int32]:
        """See `SceneTruth.labels`."""
        return self._truth.labels(self._indices[index])

    def planes(self) -> NDArray[np.float64]:
        """See `SceneTruth.planes`."""
        return self._truth.planes()

    def seen_areas_m2(self, index: int) -> NDArray[np.float64]:
        """See `SceneTruth.seen_areas_m2`."""
        return self._truth.seen_areas_m2(self._indices[index])

    def surface_distance_m(self, points_w: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `SceneTruth.surface_distance_m`."""
        return self._truth.surface_distance_m(points_w)
