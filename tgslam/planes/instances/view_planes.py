"""The segments of a keyframe as planes with their uncertainty, in its camera's frame."""

from __future__ import annotations

import numpy as np

from tgslam.config.plane_settings import UncertaintySettings
from tgslam.planes.estimate import PlaneEstimate, deviation_sigmas, from_segments, fuse
from tgslam.planes.segment import PlaneView

_DEFERRED_VARIANCE = 4.0  # factor by which an ambiguous segment is less certain than it says


class ViewPlanes:
    """Planes [S] of the segments, as certain as who looks at them may take them for."""

    def __init__(self, view: PlaneView, config: UncertaintySettings) -> None:
        self.areas_m2 = np.array([segment.area_m2 for segment in view.segments], np.float64)
        self.measured = from_segments(view.segments)  # by the sensor's noise
        self.local = self.measured.with_surface_error(self.areas_m2, config.planarity_sigma_m)  # besides, as surfaces
        for planes in (self.measured, self.local):
            planes.covariance[[not s.reliable for s in view.segments]] *= _DEFERRED_VARIANCE
        # Besides, as the sensor may bend them, which other views have not seen
        self.bent = self.local.with_sensor_bias(self.areas_m2, config.bias_per_m2)
        misfit = deviation_sigmas(self.local[:, None], self.local[None])
        self.misfit_sigmas = np.maximum(misfit, misfit.T)  # [S, S] of each segment and each other one
        self._view = view

    def combined(self, pieces: list[int]) -> tuple[PlaneEstimate, float, float]:
        """One plane from several segments, as certain as the sensor's noise leaves it; its area in m2 and RMS in m."""
        areas = self.areas_m2[pieces]
        rms_m = np.array([self._view.segments[piece].rms_m for piece in pieces])
        plane = self.measured[pieces[0]] if len(pieces) == 1 else fuse(self.measured[pieces])
        return plane, float(areas.sum()), float(np.sqrt(areas @ rms_m**2 / max(areas.sum(), 1e-12)))

    def is_step(self, segment: int, other: int) -> bool:
        """Whether two segments are level but for a step between them."""
        return (segment, other) in self._view.steps or (other, segment) in self._view.steps

    def any_reliable(self, pieces: list[int]) -> bool:
        """Whether one of the segments counts by itself."""
        return any(self._view.segments[piece].reliable for piece in pieces)
