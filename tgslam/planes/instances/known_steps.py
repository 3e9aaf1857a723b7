"""Narrow surfaces a little before or behind a larger one, sought in a view where other views have told them.

By itself a view tells such a step only where it stands out of what noise does anywhere. At a known place it may be much
fainter, and still not be chance.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import SensorNoise
from tgslam.config.plane_settings import PlanesConfig, StepSettings
from tgslam.geometry import inverse, transform_points
from tgslam.planes.estimate import stacked
from tgslam.planes.instances.instance import PlanarInstance
from tgslam.planes.instances.sight import Samples, may_appear
from tgslam.planes.segment import PlaneSegment, PlaneView

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]
Pixels = NDArray[np.int64]

_WINDOW_PX = 5  # side of the square that tells which of two surfaces a pixel shows
_BEYOND = 2.0  # times as much as what it has of a place, has a segment that is not only the surface there


def with_known_steps(
    samples: Samples, steps: Sequence[tuple[PlanarInstance, PlanarInstance]], config: PlanesConfig, noise: SensorNoise
) -> PlaneView:
    """The view of the samples, and in it segments for those surfaces that it has taken for parts of the larger ones.

    steps: (smaller, larger) instances with a step between them, one pair at least. The new segments come last, and have
    to be confirmed as all narrow ones have. noise: the depth sensor's.
    """
    view, limits = samples.view, config.expert.steps
    corners = np.stack([small.support.corners() for small, _ in steps])
    in_view = may_appear(samples, stacked([small.plane for small, _ in steps]), corners)
    least_px = config.expert.segmentation.piece_share * config.min_area_share * view.labels.size
    for small, large in (steps[i] for i in np.flatnonzero(in_view).tolist()):
        place = _Place.of(samples, view, small, config.expert.association.max_angle_rad, noise)
        step_m = float(large.plane.heights_m(small.plane.centroid))
        if place is None or not place.shows(step_m, config.expert.uncertainty.planarity_sigma_m, limits):
            continue
        chosen = place.nearer(step_m, limits.known_step_odds)
        if np.count_nonzero(chosen) >= least_px:
            view = _with_part(view, place, chosen)
    return view


@dataclass(frozen=True)
class _Place:
    """The pixels [N] of one segment that lie over the extent of an instance, or beside it."""

    segment: int
    plane: PlaneSegment
    pixels: tuple[Pixels, Pixels]  # rows and columns
    points: Vector  # [3, N] m, camera
    weight: Vector  # [N] 1/m^2, of a height over the segment's plane
    over: Mask  # [N] over the extent itself

    @classmethod
    def of(
        cls, samples: Samples, view: PlaneView, instance: PlanarInstance, max_angle_rad: float, noise: SensorNoise
    ) -> _Place | None:
        """Of that segment which has most of it; None if that is not parallel, or hardly more than the instance."""
        window = samples.window(instance.support.corners())
        rows, columns = (i + part.start for i, part in zip(np.nonzero(view.labels[window] >= 0), window, strict=True))
        points = samples.points(rows, columns)
        cells = instance.support.cells_of(transform_points(inverse(samples.T_cw), points.T))
        labels = np.where(instance.support.near(cells, 0.0), view.labels[rows, columns], -1)
        normal = samples.T_cw[:3, :3] @ instance.normal_w
        turned = np.array([normal @ plane.normal_c < np.cos(max_angle_rad) for plane in view.segments], bool)
        pixels = np.where(turned, 0, np.bincount(labels + 1, minlength=len(turned) + 1)[1:])
        segment = int(np.argmax(pixels)) if len(pixels) else 0
        if not pixels.any() or view.segments[segment].area_px < _BEYOND * pixels[segment]:
            return None
        plane, chosen = view.segments[segment], labels == segment
        points = points[:, chosen]
        weight = 1.0 / (noise.per_m2 * points[2] * (plane.normal_c @ points)) ** 2
        over = instance.support.holds(cells[chosen])
        return cls(segment, plane, (rows[chosen], columns[chosen]), points, weight, over)

    @property
    def heights_m(self) -> Vector:
        """[N] over the segment's plane."""
        return self.plane.normal_c @ self.points + self.plane.offset_m

    def shows(self, step_m: float, planarity_sigma_m: float, config: StepSettings) -> bool:
        """Whether about as much as the extent holds stands off the segment's plane, which squares of pixels can tell.

        Cells do not follow the border of a narrow surface: part of it lies beside its extent.
        """
        sigma_m = float(np.hypot(1.0 / (_WINDOW_PX * np.sqrt(np.median(self.weight))), planarity_sigma_m))
        if 0.5 * abs(step_m) < config.known_step_sigmas * sigma_m or not self.over.any():
            return False
        return bool(np.count_nonzero(self._gain(step_m) > 0) >= config.known_step_share * np.count_nonzero(self.over))

    def nearer(self, step_m: float, odds: float) -> Mask:
        """[N] the pixels that more likely show a plane at such a step than the segment's. odds: by others."""
        return self._gain(step_m) > np.where(self.over, -odds, odds)

    def _gain(self, step_m: float) -> Vector:
        """[N] logarithm of how much likelier a plane at such a step makes the measurements around each pixel."""
        (rows, columns), (top, left) = self.pixels, (i.min() for i in self.pixels)
        gain = np.zeros((rows.max() - top + 1, columns.max() - left + 1))
        gain[rows - top, columns - left] = self.weight * step_m * (self.heights_m - 0.5 * step_m)
        window = (_WINDOW_PX, _WINDOW_PX)
        around = cv2.boxFilter(gain, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(around[rows - top, columns - left])


def _with_part(view: PlaneView, place: _Place, chosen: Mask) -> PlaneView:
    """The view where the chosen pixels [N] of a place are a segment of their own, parallel to the one they were of."""
    large, points, weight = place.plane, place.points[:, chosen], place.weight[chosen]
    height_m = float(weight @ place.heights_m[chosen] / weight.sum())
    rest_m = place.heights_m[chosen] - height_m
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = large.covariance[:2, :2]
    covariance[2, 2] = 1.0 / weight.sum()
    part = PlaneSegment(
        normal_c=large.normal_c,
        offset_m=large.offset_m - height_m,
        centroid_c=points @ weight / weight.sum(),
        covariance=covariance,
        area_px=len(weight),
        area_m2=large.area_m2 / large.area_px * len(weight),
        rms_sigmas=float(np.sqrt(np.mean(weight * rest_m**2))),
        rms_m=float(np.sqrt(np.mean(rest_m**2))),
        reliable=False,
    )
    labels = view.labels.copy()
    labels[tuple(i[chosen] for i in place.pixels)] = len(view.segments)
    segments = list(view.segments)
    segments[place.segment] = dataclasses.replace(large, area_px=large.area_px - part.area_px)
    return PlaneView(labels, (*segments, part), view.steps | {(len(segments), place.segment)})
