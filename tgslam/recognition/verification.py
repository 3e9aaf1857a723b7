"""Are two keyframes that look alike views of one place, and what is the motion between them?

Features that match by their looks must agree on one motion, which RANSAC finds and robust Gauss-Newton refines on
their pixels and depths, each weighted by its noise in both views. What the two views show besides must not speak
against it: all of the two depth images, and features that one has where the other one, on the same surface, has none.
Where features are few or close together the surfaces that both views show hold the motion better than they do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera, SensorNoise
from tgslam.config.graph_settings import LoopConfig
from tgslam.device import runtime
from tgslam.geometry import adjoint, inverse, transform_points
from tgslam.ops import closure_icp as closure_fit
from tgslam.recognition.depth_agreement import DepthGrid, agreement, compared
from tgslam.recognition.features import Features, matches
from tgslam.relative_motion import Measurement, Quadratic, solve

Vector = NDArray[np.float64]

_RANSAC_ROUNDS = 150  # at most: where half of the matches are right, four right ones are drawn all but surely
_CONFIDENCE = 0.999  # that the best motion has been sampled, to stop before
_FIRST_STEPS = 3  # before it is decided anew which features agree; the sampled motion is close already
_ROBUST_SIGMAS = 3.0  # beyond which a feature counts less: few right ones are
_SURFACE_STEPS = 4  # at most: matches change from step to step, so that they never settle to the last digit
_MATCH_DISTANCE_M = 0.1  # of surfaces: those farther apart are different ones
_INLIER_SIGMAS = 4.0  # of three coordinates: one right match in a thousand is farther off
_PLACES_ACROSS = 80  # the image: features in one of its squares are one, as corners found on several levels are


@dataclass(frozen=True)
class Look:
    """What is kept of a keyframe."""

    features: Features
    depth: DepthGrid


@dataclass(frozen=True)
class Points:
    """Features [N] that match, with their noise."""

    in_i: Vector  # [N, 3] m
    covariance_i: Vector  # [N, 3, 3] m^2
    seen_j: Vector  # [N, 3] px, px, m
    variance_j: Vector  # [N, 3]

    def __getitem__(self, rows: NDArray[np.generic]) -> Points:
        return Points(self.in_i[rows], self.covariance_i[rows], self.seen_j[rows], self.variance_j[rows])


@dataclass(frozen=True)
class _Surfaces:
    """A view's depth on the device."""

    points: np.ndarray  # [N, 3] m, camera
    depth_m: np.ndarray  # [h, w] m, 0 = none
    camera: Camera

    @classmethod
    def of(cls, depth: DepthGrid) -> _Surfaces:
        return cls(runtime.to_device(depth.points()), runtime.to_device(depth.depth_m), depth.camera)


@dataclass(frozen=True)
class Sameness:
    """A verified pair of keyframes."""

    measured: Measurement  # in all six directions, by features
    inliers: int  # of them, at different places
    points: Points  # those


class Verification:
    """The tests of a pair, with what all pairs have in common."""

    def __init__(self, camera: Camera, noise: SensorNoise, config: LoopConfig) -> None:
        self._camera, self._noise, self._config = camera, noise, config

    def compare(self, look_i: Look, look_j: Look) -> Sameness | None:
        """None unless the geometry speaks for one place beyond doubt."""
        config, place, limits = self._config, self._config.expert.place, self._config.expert.acceptance
        pairs = matches(look_i.features, look_j.features, config.expert.matching)
        if len(pairs) < place.min_inliers:
            return None
        points = self._points(look_i.features, look_j.features, pairs)
        T_ji, agree = self._sampled(points)
        if agree.sum() < place.min_inliers:
            return None
        measured = solve(partial(self._of_points, points[agree]), T_ji, limits, _FIRST_STEPS)
        agree = self._squares(points, measured.T_ji) < _INLIER_SIGMAS**2
        if agree.mean() < place.min_inlier_share or self._places(points.seen_j[agree]) < place.min_inliers:
            return None
        measured = solve(partial(self._of_points, points[agree]), measured.T_ji, limits)
        if measured.rank < 6 or agree.sum() < place.min_seen_again * self._in_both(look_i, look_j, measured.T_ji):
            return None
        agreeing, overlap = agreement(look_i.depth, look_j.depth, measured.T_ji, self._noise)
        if agreeing < place.min_depth_agreement or overlap < place.min_depth_overlap:
            return None
        return Sameness(measured, self._places(points.seen_j[agree]), points[agree])

    def refined(self, same: Sameness, look_i: Look, look_j: Look) -> Measurement:
        """With the distances between the two depth images' surfaces, in both directions, besides the features."""
        views = _Surfaces.of(look_i.depth), _Surfaces.of(look_j.depth)
        limits = self._config.expert.acceptance
        return solve(partial(self._of_all, same.points, *views), same.measured.T_ji, limits, _SURFACE_STEPS)

    def _of_all(self, points: Points, view_i: _Surfaces, view_j: _Surfaces, T_ji: Vector) -> Quadratic:
        """Surfaces have an error in common as features do; either view's count half."""
        forth, back = self._of_surfaces(view_j, view_i, inverse(T_ji)), self._of_surfaces(view_i, view_j, T_ji)
        turned = -adjoint(inverse(T_ji))  # a perturbation of T_ji as one of T_ij
        A, b = forth.A + turned.T @ back.A @ turned, forth.b + turned.T @ back.b
        return self._of_points(points, T_ji) + self._limited(0.5 * A, 0.5 * b, 0.0, 0)

    def _of_surfaces(self, moving: _Surfaces, still: _Surfaces, T: Vector) -> closure_fit.SurfaceDistances:
        """In a left perturbation of the inverse of T, which takes `moving` to `still`."""
        floor_m = self._config.expert.measuring.depth_floor_sigma_m
        return closure_fit.surface_distances(
            moving.points, T, still.depth_m, still.camera, self._noise, floor_m, _MATCH_DISTANCE_M
        )

    def _points(self, in_i: Features, in_j: Features, pairs: NDArray[np.int64]) -> Points:
        """A feature's noise is that of its pixel, which the level of the pyramid scales, and of its depth."""
        camera, (i, j) = self._camera, pairs.T
        points = in_i.points(camera)[i]
        rays = points / points[:, 2:]
        along = points[:, 2] / np.array([[camera.fx], [camera.fy]])  # m per px
        variance_i, variance_j = self._variance(in_i)[i], self._variance(in_j)[j]
        covariance = variance_i[:, 2, None, None] * rays[:, :, None] * rays[:, None, :]
        for axis in range(2):
            covariance[:, axis, axis] += variance_i[:, axis] * along[axis] ** 2
        seen_j = np.column_stack([in_j.pixels, in_j.depth_m]).astype(np.float64)[j]
        return Points(points, covariance, seen_j, variance_j)

    def _variance(self, features: Features) -> Vector:
        """[N, 3] px^2, px^2, m^2."""
        config = self._config.expert.measuring
        pixel = (config.pixel_sigma * features.scale.astype(np.float64)) ** 2
        depth = self._noise.sigma_m(features.depth_m.astype(np.float64)) ** 2 + config.depth_floor_sigma_m**2
        return np.column_stack([pixel, pixel, depth])

    def _sampled(self, points: Points) -> tuple[Vector, NDArray[np.bool_]]:
        """A motion [4, 4] that many points agree on, by their pixels, and which they are; RANSAC seeds itself."""
        found, rotation, shift, rows = cv2.solvePnPRansac(
            points.in_i, points.seen_j[:, :2], self._camera.matrix, None, iterationsCount=_RANSAC_ROUNDS,
            reprojectionError=self._config.expert.measuring.inlier_px, confidence=_CONFIDENCE, flags=cv2.SOLVEPNP_AP3P,
        )  # fmt: skip
        T_ji, agree = np.eye(4), np.zeros(len(points.in_i), np.bool_)
        if found and rows is not None and np.isfinite(rotation).all() and np.isfinite(shift).all():
            T_ji[:3, :3], T_ji[:3, 3] = cv2.Rodrigues(rotation)[0], shift[:, 0]
            agree[rows[:, 0]] = True
        return T_ji, agree

    def _errors(self, points: Points, T_ji: Vector) -> tuple[Vector, Vector, Vector]:
        """Of (px, px, m) in j: [N, 3], their covariances [N, 3, 3] and derivatives [N, 3, 6] by a left perturbation."""
        camera = self._camera
        p = transform_points(T_ji, points.in_i)
        z = np.maximum(p[:, 2], 1e-3)  # what has come to lie behind the camera has errors that count for nothing
        by_point = np.zeros((len(p), 3, 3))
        by_point[:, 0, 0], by_point[:, 0, 2] = camera.fx / z, -camera.fx * p[:, 0] / z**2
        by_point[:, 1, 1], by_point[:, 1, 2] = camera.fy / z, -camera.fy * p[:, 1] / z**2
        by_point[:, 2, 2] = 1.0
        seen = np.column_stack([*camera.project(p), p[:, 2]])
        turned = by_point @ T_ji[:3, :3]
        covariance = turned @ points.covariance_i @ np.swapaxes(turned, 1, 2)
        covariance[:, range(3), range(3)] += points.variance_j
        moved = np.tile(np.eye(3, 6, 3), (len(p), 1, 1))  # [N, 3, 6] the point's derivatives: -hat(p), 1
        moved[:, [1, 2, 0], [2, 0, 1]] = p
        moved[:, [2, 0, 1], [1, 2, 0]] = -p
        return seen - points.seen_j, covariance, by_point @ moved

    def _squares(self, points: Points, T_ji: Vector) -> Vector:
        """[N] squared Mahalanobis distances."""
        error, covariance, _ = self._errors(points, T_ji)
        return np.sum(error * np.linalg.solve(covariance, error[:, :, None])[:, :, 0], axis=1)

    def _of_points(self, points: Points, T_ji: Vector) -> Quadratic:
        """What the points say near T_ji, with Cauchy weights, and no more than their common error leaves of it."""
        error, covariance, jacobian = self._errors(points, T_ji)
        white = np.linalg.solve(covariance, np.concatenate([jacobian, error[:, :, None]], axis=2))
        squares = np.sum(error * white[:, :, 6], axis=1)
        white = white / (1.0 + squares[:, None, None] / _ROBUST_SIGMAS**2)
        A, b = np.einsum("nki,nkj->ij", jacobian, white[:, :, :6]), np.einsum("nki,nk->i", jacobian, white[:, :, 6])
        return self._limited(A, b, float(squares.sum()), 3 * len(error))

    def _limited(self, A: Vector, b: Vector, value: float, count: int) -> Quadratic:
        """Normal equations without the certainty that an error common to all of the residuals takes away."""
        config = self._config.expert.measuring
        limit = np.array([config.common_sigma_rad] * 3 + [config.common_sigma_m] * 3) ** -2.0
        share = np.linalg.solve(A + np.diag(limit), np.column_stack([A, b])) * limit[:, None]
        return Quadratic(share[:, :6], share[:, 6], value, count)

    def _in_both(self, look_i: Look, look_j: Look, T_ji: Vector) -> int:
        """How many features of one view, the one that has more of them, are on surfaces that the other one sees."""
        from_i, from_j = look_i.features.points(self._camera), look_j.features.points(self._camera)
        ahead, _ = compared(from_i, T_ji, look_j.depth, self._noise)
        back, _ = compared(from_j, inverse(T_ji), look_i.depth, self._noise)
        return max(ahead, back)

    def _places(self, seen: Vector) -> int:
        """How many squares of the image hold any of the pixels [N, 3]."""
        squares = seen[:, :2] // (self._camera.width / _PLACES_ACROSS)
        return len(np.unique(squares, axis=0))
