"""What the rendered views have shown of each Gaussian."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tgslam.device import runtime
from tgslam.map.gaussians import grown
from tgslam.ops import rows

_MIN_CAPACITY = 64


class Sightings:
    """Device arrays with a row for each Gaussian, and spare capacity that doubles."""

    def __init__(self) -> None:
        self.rows = 0
        self._contribution = runtime.zeros((_MIN_CAPACITY,))
        self._views = runtime.zeros((_MIN_CAPACITY,), np.int32)

    @property
    def most_px(self) -> np.ndarray:
        """`contribution` as the device array, with spare rows."""
        return self._contribution

    @property
    def contribution(self) -> NDArray[np.float32]:
        """[N] px on the host: since birth the most blend weight in any view."""
        return runtime.to_host(self._contribution)[: self.rows]

    @property
    def views(self) -> NDArray[np.int32]:
        """[N] on the host: views rendered with the Gaussian in sight."""
        return runtime.to_host(self._views)[: self.rows]

    def append(self, rows: int) -> None:
        """Add rows that no view has seen."""
        capacity = self._views.shape[0]
        if self.rows + rows > capacity:
            self._resize(np.arange(self.rows), max(2 * capacity, self.rows + rows))
        self.rows += rows

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Remove the rows where the mask [N] is false."""
        kept = np.flatnonzero(mask)
        self._resize(kept, self._views.shape[0])
        self.rows = len(kept)

    def record(self, visible: np.ndarray, curvature: np.ndarray, totals: np.ndarray, weight: float) -> None:
        """Count a view; arguments as in `ops.rows.record_view`."""
        rows.record_view(self.rows, visible, curvature, totals, weight, self._contribution, self._views)

    def _resize(self, kept: NDArray[np.integer], capacity: int) -> None:
        self._contribution = grown(self.contribution[kept], len(kept), capacity)
        self._views = grown(self.views[kept], len(kept), capacity)
