"""Multi-plane ICP: the motion between two keyframes refined on the points themselves.

The points of both views are held against their common plane with robust weights, and each view's plane is fitted anew
to its own; that takes out pixels that are on the plane in one view's segmentation only. Points on no plane are held
against the other view's surface, and fill directions that the planes leave free. However many points there are, the
information is that of the planes' own fits, and of the points off them no more than what they have in error together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.graph_settings import AcceptanceSettings, IcpSettings
from tgslam.device import runtime
from tgslam.geometry import adjoint, inverse
from tgslam.graph.relative import PlanePairs, of_planes
from tgslam.ops import closure_icp as closure_fit
from tgslam.planes.estimate import PlaneEstimate, fuse, stacked
from tgslam.relative_motion import Measurement, Quadratic, solve
from tgslam.types import FloatImage

Vector = NDArray[np.float64]

_STEPS = 3  # at most of a round: matches change from step to step, so that they never settle to the last digit
_LEAST_POINTS = 30  # of a plane, to fit it anew: of fewer, the view's own fit is better
_LEAST_SHARE = 1e-3  # of the information of a plane's best known parameter that of the worst one is at least
_BEHIND = np.array([[0.0, 0.0, -1e3]])  # m: a point that meets nothing, since arrays on a device cannot be empty
_MAX_SQUARES = 2.0  # mean squared residual, in sigmas, of points that match something: right ones have about 1


@dataclass(frozen=True)
class View:
    """A keyframe's depth image and what lies on which plane."""

    depth_m: FloatImage  # [H, W] on the host, 0 = none
    plane_ids: NDArray[np.integer]  # [H, W] PGI of each pixel, -1 = none


@dataclass(frozen=True)
class _Samples:
    """A view on the device."""

    planar: np.ndarray  # [N, 3] m, camera: points on the planes
    row: np.ndarray  # [N] int32 which of them
    others: np.ndarray  # [M, 3] m, on no plane
    surface_m: np.ndarray  # [H, W] m, of what is on no plane, 0 = none

    @classmethod
    def of(cls, view: View, shared: Sequence[int], camera: Camera, step_px: int) -> _Samples:
        """Every step-th pixel of both kinds."""
        v, u = np.mgrid[step_px // 2 : camera.height : step_px, step_px // 2 : camera.width : step_px].reshape(2, -1)
        z, ids = view.depth_m[v, u].astype(np.float64), view.plane_ids[v, u]
        points = camera.points_at(u, v, z)
        row = np.full(len(z), -1)
        for index, plane_id in enumerate(shared):
            row[ids == plane_id] = index
        on, off = (z > 0) & (row >= 0), (z > 0) & (ids < 0)
        surface = np.where(view.plane_ids < 0, view.depth_m, np.float32(0.0))
        return cls(
            runtime.to_device(np.vstack([points[on], _BEHIND])),
            runtime.to_device(np.append(row[on], -1), np.int32),
            runtime.to_device(np.vstack([points[off], _BEHIND])),
            runtime.to_device(surface),
        )


class Registration:
    """Two keyframes' points, ready to be brought together."""

    def __init__(
        self,
        views: tuple[View, View],
        shared: Sequence[int],
        camera: Camera,
        noise: SensorNoise,
        config: IcpSettings,
        limits: AcceptanceSettings,
    ) -> None:
        """views: of the keyframes i and j. shared: the PGIs that are matched."""
        self._i, self._j = (_Samples.of(view, shared, camera, config.samples_px) for view in views)
        self._camera, self._noise, self._config, self._limits = camera, noise, config, limits

    def refine(self, pairs: PlanePairs, start: Measurement) -> Measurement:
        """From the motion that the views' planes gave; directions that nothing measures stay as they are there."""
        found = start
        for _ in range(self._config.icp_rounds):
            refitted = self._refitted(pairs, found.T_ji)
            found = solve(partial(self._of_all, refitted), found.T_ji, self._limits, _STEPS)
        return found

    def _refitted(self, pairs: PlanePairs, T_ji: Vector) -> PlanePairs:
        """Each view's planes fitted to its points, weighted by how well these agree with both views' planes."""
        moved = pairs.in_i.transformed(T_ji)
        common = stacked([fuse(stacked([moved[k], pairs.in_j[k]])) for k in range(len(pairs))])
        in_i = self._fitted(self._i, common.transformed(inverse(T_ji)), pairs.in_i)
        return PlanePairs(in_i, self._fitted(self._j, common, pairs.in_j))

    def _fitted(self, samples: _Samples, common: PlaneEstimate, own: PlaneEstimate) -> PlaneEstimate:
        columns = [common.normal, common.offset_m[:, None]]
        for k in range(2):
            axis = common.axes[:, k]
            columns += [axis, np.sum(axis * common.centroid, axis=1, keepdims=True)]
        sums = closure_fit.height_moments(
            samples.planar, samples.row, np.hstack(columns), self._noise, self._config.flatness_sigma_m
        )
        return stacked([self._fitted_one(sums, k, common[k], own[k]) for k in range(len(sums.points))])

    def _fitted_one(
        self, sums: closure_fit.HeightMoments, index: int, common: PlaneEstimate, own: PlaneEstimate
    ) -> PlaneEstimate:
        """The view's own plane where too few points say too little."""
        scale = np.linalg.eigvalsh(sums.information[index])
        if sums.points[index] < _LEAST_POINTS or scale[0] < _LEAST_SHARE * scale[2]:
            return own
        error = np.linalg.solve(sums.information[index], sums.moment[index])
        normal = common.normal - error[0] * common.axes[1] + error[1] * common.axes[0]
        normal = normal / np.linalg.norm(normal)
        offset = -normal @ (common.centroid + error[2] * common.normal)
        first = own.axes[0] - (own.axes[0] @ normal) * normal
        first = first / np.linalg.norm(first)
        centroid = own.centroid - (own.centroid @ normal + offset) * normal
        return PlaneEstimate(
            normal, np.asarray(offset), centroid, np.stack([first, np.cross(normal, first)]), own.covariance
        )

    def _of_all(self, pairs: PlanePairs, T_ji: Vector) -> Quadratic:
        """Planes, and the points off them, of which either view's count half."""
        total = of_planes(pairs, T_ji)
        forth, back = self._off_planes(self._j, self._i, inverse(T_ji)), self._off_planes(self._i, self._j, T_ji)
        if forth is None or back is None:
            return total
        turned = -adjoint(inverse(T_ji))  # a perturbation of T_ji as one of T_ij
        A = 0.5 * (forth.A + turned.T @ back.A @ turned)
        return total + Quadratic(A, 0.5 * (forth.b + turned.T @ back.b), 0.0, 0)

    def _off_planes(self, moving: _Samples, still: _Samples, T: Vector) -> Quadratic | None:
        """In a left perturbation of the inverse of T, which takes `moving` to `still`; None without a good match."""
        config = self._config
        found = closure_fit.surface_distances(
            moving.others,
            T,
            still.surface_m,
            self._camera,
            self._noise,
            config.flatness_sigma_m,
            config.match_distance_m,
        )
        if found.matches < config.min_matches or found.squares > _MAX_SQUARES * found.matches:
            return None
        limit = np.array([config.match_sigma_rad] * 3 + [config.match_sigma_m] * 3) ** -2.0
        share = np.linalg.solve(found.A + np.diag(limit), np.column_stack([found.A, found.b])) * limit[:, None]
        return Quadratic(share[:, :6], share[:, 6], 0.0, 0)
