"""What a depth image says about places on planes: whether it shows them, hides them or sees through them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.plane_settings import PlanesConfig
from tgslam.geometry import inverse, transform_points
from tgslam.planes.estimate import PlaneEstimate
from tgslam.planes.instances.support import Cells, Support
from tgslam.planes.segment import PlaneView
from tgslam.types import FloatImage

Vector = NDArray[np.float64]

_NEAREST_M = 0.05  # places nearer to the camera's plane than this are not projected
_GRAZING_COSINE = 0.05  # rays flatter than this say nothing of where they meet a plane
_MARGIN_PX = 8  # around what is looked for in an image: its border is known to some cells
_MAX_FOOTPRINT_CELLS = 1 << 20  # a degenerate segment does not make the grid explode


@dataclass(frozen=True)
class Tolerance:
    """How far a measured point may lie off a plane that it belongs to: `sigmas` standard deviations of the height."""

    sigmas: float
    noise: SensorNoise
    pose_rad: float
    pose_m: float

    @classmethod
    def of(cls, config: PlanesConfig, noise: SensorNoise) -> Tolerance:
        """As the settings say."""
        expert = config.expert
        pose = expert.uncertainty
        return cls(expert.association.gate_sigmas, noise, pose.pose_sigma_rad, pose.pose_sigma_m)


@dataclass(frozen=True)
class Samples:
    """The pixels with depth on a regular grid of a keyframe, which stand for the whole image, and its labels."""

    camera: Camera
    T_cw: Vector  # [4, 4]
    view: PlaneView
    depth_m: FloatImage  # [H, W]
    rays: NDArray[np.float32]  # [M, 3] camera frame, z = 1
    z_m: NDArray[np.float32]  # [M] m
    label: NDArray[np.int32]  # [M] index of the segment, -1 = none

    @classmethod
    def of(cls, view: PlaneView, depth_m: FloatImage, camera: Camera, T_cw: Vector, width_px: int) -> Samples:
        """At most `width_px` samples a row, equally far apart in both directions."""
        step = -(-camera.width // width_px)
        z, label = depth_m[step // 2 :: step, step // 2 :: step], view.labels[step // 2 :: step, step // 2 :: step]
        rows, columns = np.nonzero(z > 0)
        u, v = columns * step + step // 2, rows * step + step // 2
        rays = camera.rays_at(u, v).astype(np.float32)
        return cls(camera, T_cw, view, depth_m, rays, z[rows, columns], label[rows, columns])

    @property
    def position_w(self) -> Vector:
        """[3] m: the camera's place."""
        return inverse(self.T_cw)[:3, 3]

    def points_w(self, segment: int) -> Vector:
        """[K, 3] m: the samples of one segment in the world."""
        chosen = self.label == segment
        return transform_points(inverse(self.T_cw), self.rays[chosen] * self.z_m[chosen, None])

    def points(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Vector:
        """[3, N] m, camera frame: of pixels [N], all of which are measured."""
        return np.ascontiguousarray(self.camera.points_at(columns, rows, self.depth_m[rows, columns]).T)

    def window(self, points_w: Vector) -> tuple[slice, slice]:
        """Rows and columns between which the convex hull of points [N, 3] m appears, and a margin of a few pixels."""
        points = transform_points(self.T_cw, points_w)
        height, width = self.camera.shape
        if points[:, 2].min() <= _NEAREST_M:
            return slice(0, height), slice(0, width)
        u, v = self.camera.project(points)
        return _span(v, height), _span(u, width)

    def pixels(self, points_w: Vector) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Where points [N, 3] m appear: columns and rows (0 outside), and whether they are in the image."""
        points = transform_points(self.T_cw, points_w)
        u, v = (np.rint(place) for place in self.camera.project(points))
        inside = (points[:, 2] > _NEAREST_M) & self.camera.holds(u, v)
        return np.where(inside, u, 0).astype(np.int64), np.where(inside, v, 0).astype(np.int64), inside

    def footprint(self, segment: int, support: Support) -> Cells:
        """The cells [N, 2] of a grid that a segment covers: those whose middle it shows."""
        points = self.points_w(segment)
        if len(points) == 0:
            return np.zeros((0, 2), np.int64)
        touched = support.cells_of(points)
        low, high = touched.min(axis=0) - 1, touched.max(axis=0) + 2
        if np.prod(high - low) > _MAX_FOOTPRINT_CELLS:
            return np.unique(touched, axis=0)
        i, j = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]), indexing="ij")
        cells = np.column_stack([i.ravel(), j.ravel()])
        u, v, inside = self.pixels(support.centres(cells))
        shown = cells[inside & (self.view.labels[v, u] == segment)]
        # A strip thinner than a cell may hold no cell's middle
        return shown if len(shown) else np.unique(touched, axis=0)


@dataclass(frozen=True)
class Sight:
    """What a keyframe's samples say about the extent of one plane."""

    shown: NDArray[np.int64]  # [K] samples that lie on it: the mask M_g of Eq. 6
    through_count: int  # samples that lie behind it although their ray crosses its extent
    through_cells: Cells  # [N, 2] cells crossed by those

    @property
    def through_share(self) -> float:
        """Of the extent that is in the image and not hidden."""
        return self.through_count / max(self.through_count + len(self.shown), 1)


def sight(samples: Samples, plane: PlaneEstimate, support: Support, tolerance: Tolerance) -> Sight:
    """How a plane with its extent (both in the world) appears in a keyframe.

    Each sample's ray is cut with the plane and the cell there is looked up: the same as projecting sampled points of
    the plane, but without holes between them. A sample well in front of the plane hides it, and says nothing.
    """
    local = plane.transformed(samples.T_cw)
    facing = samples.rays @ local.normal.astype(np.float32)
    height = facing * samples.z_m + np.float32(local.offset_m)
    variance = (tolerance.noise.sigma_m(samples.z_m) * facing) ** 2
    variance += tolerance.pose_m**2 + plane.covariance[2, 2] + (tolerance.pose_rad * samples.z_m) ** 2
    limit = np.float32(tolerance.sigmas) * np.sqrt(variance)
    candidates = np.flatnonzero((facing < -_GRAZING_COSINE) & (height <= limit))
    hit = samples.rays[candidates] * (-np.float32(local.offset_m) / facing[candidates])[:, None]
    cells = support.cells_of(transform_points(inverse(samples.T_cw), hit))
    inside = support.holds(cells)
    candidates, cells = candidates[inside], cells[inside]
    behind = height[candidates] < -limit[candidates]
    return Sight(candidates[~behind], int(behind.sum()), np.unique(cells[behind], axis=0))


def may_appear(samples: Samples, planes: PlaneEstimate, corners_w: Vector) -> NDArray[np.bool_]:
    """Which planes [G] with the rectangles [G, 4, 3] m turn their front to the camera and may be in the image."""
    front = planes.heights_m(samples.position_w) > 0
    x, y, z = np.moveaxis(transform_points(samples.T_cw, corners_w), -1, 0)
    camera = samples.camera
    sides = (
        z - _NEAREST_M,
        camera.fx * x + camera.cx * z,
        camera.fy * y + camera.cy * z,
        (camera.width - 1 - camera.cx) * z - camera.fx * x,
        (camera.height - 1 - camera.cy) * z - camera.fy * y,
    )
    for side in sides:  # a rectangle wholly outside one side of the frustum is not in view
        front &= (side > 0).any(axis=-1)
    return front


def _span(places: Vector, size: int) -> slice:
    """The pixels of an image of such a size between places [N] px, and a margin."""
    low, high = (int(np.clip(i, 0, size)) for i in (places.min() - _MARGIN_PX, places.max() + _MARGIN_PX + 1))
    return slice(low, high)
