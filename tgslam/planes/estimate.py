"""Planes with their uncertainty: moving them between frames, comparing them, fusing them. n . x + d = 0, |n| = 1.

A plane's error has three parameters, those of `PlaneSegment.covariance`: rotations (alpha, beta) about the two tangents
and an offset delta along the normal at the centroid. To first order the plane stands delta + alpha v - beta u above the
true one at the place (u, v) along the tangents from the centroid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.geometry import tangent_axes
from tgslam.planes.segment import PlaneSegment

Vector = NDArray[np.float64]
_HUBER_DEVIATION = 2.0  # sigmas from which a view of a plane counts less and less
_ROBUST_STEPS = 3  # of weighting anew, at most


@dataclass(frozen=True)
class PlaneEstimate:
    """One plane or an array of planes (any leading shape) in one frame."""

    normal: Vector  # [..., 3] unit
    offset_m: Vector  # [...]
    centroid: Vector  # [..., 3] m, on the plane
    axes: Vector  # [..., 2, 3] unit tangents, right-handed with the normal: what the covariance speaks of
    covariance: Vector  # [..., 3, 3] of (alpha rad, beta rad, delta m)

    def __getitem__(self, key: Any) -> PlaneEstimate:
        """Some of an array of planes."""
        return PlaneEstimate(
            self.normal[key], self.offset_m[key], self.centroid[key], self.axes[key], self.covariance[key]
        )

    def transformed(self, T_ab: Vector) -> PlaneEstimate:
        """The planes, given in frame b, in frame a. T_ab [..., 4, 4]: n_a = R n_b, d_a = d_b - n_a . t."""
        R, t = T_ab[..., :3, :3], T_ab[..., :3, 3]
        normal = np.einsum("...ij,...j->...i", R, self.normal)
        return PlaneEstimate(
            normal,
            self.offset_m - np.sum(normal * t, axis=-1),
            np.einsum("...ij,...j->...i", R, self.centroid) + t,
            np.einsum("...ij,...kj->...ki", R, self.axes),
            self.covariance,
        )

    def heights_m(self, points: Vector) -> Vector:
        """Signed distances n . x + d of points [..., 3], positive on the side that the normal points to."""
        return np.sum(self.normal * points, axis=-1) + self.offset_m

    def widened(self, sigma_rad: float, sigma_m: float) -> PlaneEstimate:
        """With independent errors added to the angles and to the offset at the centroid."""
        return self._with_covariance(self.covariance + np.diag([sigma_rad**2, sigma_rad**2, sigma_m**2]))

    def with_pose_error(self, sigma_rad: float | Vector, sigma_m: float | Vector) -> PlaneEstimate:
        """Planes in a camera's frame, with the camera's own rotation and translation uncertain by so much per axis.

        A rotation w about the camera turns a plane by (t1 . w, t2 . w) and lifts its centroid r by w . (r x n).
        Arrays of errors that broadcast with the planes give the covariance their shape; the other parts keep theirs.
        """
        lever = np.cross(self.centroid, self.normal)[..., None, :]
        turned = np.concatenate([self.axes, lever], axis=-2)  # [..., 3, 3] error per rotation of the camera
        added = np.multiply.outer(np.square(sigma_rad), np.ones((3, 3))) * (turned @ np.swapaxes(turned, -1, -2))
        added = added + np.multiply.outer(np.square(sigma_m), np.diag([0.0, 0.0, 1.0]))
        return self._with_covariance(self.covariance + added)

    def with_surface_error(self, areas_m2: Vector, sigma_m: float | Vector) -> PlaneEstimate:
        """With what does not average out over the pixels of a surface: it strays from the plane by so much at the
        centroid, and in its angles by as much over its size.
        """
        variance = np.broadcast_to(np.square(sigma_m), np.shape(areas_m2))
        turn = variance / np.maximum(areas_m2, 1e-4)
        added = np.zeros((*variance.shape, 3, 3))
        added[..., 0, 0], added[..., 1, 1], added[..., 2, 2] = turn, turn, variance
        return self._with_covariance(self.covariance + added)

    def with_sensor_bias(self, areas_m2: Vector, per_m2: float) -> PlaneEstimate:
        """Planes in a camera's frame, bent by the sensor: `with_surface_error` of per_m2 * z^2 at the depth z."""
        return self.with_surface_error(areas_m2, per_m2 * self.centroid[..., 2] ** 2)

    def _with_covariance(self, covariance: Vector) -> PlaneEstimate:
        return PlaneEstimate(self.normal, self.offset_m, self.centroid, self.axes, covariance)


def from_segments(segments: Sequence[PlaneSegment]) -> PlaneEstimate:
    """The planes of a view [N], in its camera's frame."""
    normal = np.array([s.normal_c for s in segments], np.float64).reshape(-1, 3)
    return PlaneEstimate(
        normal,
        np.array([s.offset_m for s in segments], np.float64),
        np.array([s.centroid_c for s in segments], np.float64).reshape(-1, 3),
        tangent_axes(normal),
        np.array([s.covariance for s in segments], np.float64).reshape(-1, 3, 3),
    )


def stacked(planes: Sequence[PlaneEstimate]) -> PlaneEstimate:
    """Single planes of one frame as an array [N]."""
    return PlaneEstimate(
        np.array([p.normal for p in planes]).reshape(-1, 3),
        np.array([p.offset_m for p in planes]).reshape(-1),
        np.array([p.centroid for p in planes]).reshape(-1, 3),
        np.array([p.axes for p in planes]).reshape(-1, 2, 3),
        np.array([p.covariance for p in planes]).reshape(-1, 3, 3),
    )


def concatenated(first: PlaneEstimate, second: PlaneEstimate) -> PlaneEstimate:
    """Two arrays of planes one after the other."""
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    return PlaneEstimate(*(np.concatenate(pair) for pair in pairs))


def difference(planes: PlaneEstimate, reference: PlaneEstimate) -> tuple[Vector, Vector]:
    """Errors [..., 3] (alpha rad, beta rad, delta m) of planes against reference planes, and their covariance.

    Leading shapes broadcast. The turns are about the reference's axes. The shift is the height of the plane's own
    centroid, which is where the plane is best known; comparing there makes the result independent of the origin. The
    covariance is that of both planes, the reference's being carried over to that place.
    """
    angles = _angles(planes.normal, reference)
    error = np.concatenate([angles, reference.heights_m(planes.centroid)[..., None]], axis=-1)
    at_centroid = _to_axes(reference, reference.axes, planes.centroid)
    own = _to_axes(planes, reference.axes, planes.centroid)
    return error, _carried(own, planes.covariance) + _carried(at_centroid, reference.covariance)


def deviation_sigmas(planes: PlaneEstimate, reference: PlaneEstimate) -> Vector:
    """Mahalanobis distances [...] of planes from reference planes: of their `difference`."""
    error, covariance = difference(planes, reference)
    solved = np.linalg.solve(covariance, error[..., None])[..., 0]
    return np.sqrt(np.sum(error * solved, axis=-1))


def offset_sigmas(planes: PlaneEstimate, reference: PlaneEstimate) -> Vector:
    """How far [...] reference planes pass by the planes' centroids, in standard deviations of both."""
    at_centroid = _carried(_to_axes(reference, reference.axes, planes.centroid), reference.covariance)
    variance = planes.covariance[..., 2, 2] + at_centroid[..., 2, 2]
    distance: Vector = np.abs(reference.heights_m(planes.centroid)) / np.sqrt(variance)
    return distance


def fuse(planes: PlaneEstimate, independent: float = np.inf) -> PlaneEstimate:
    """The one plane that estimates [N] of it, in one frame, agree on best: information-weighted, with Huber weights.

    independent: estimates beyond so many add no certainty, since their errors are not independent of each other.
    """
    certainty = 1.0 / planes.covariance[:, 2, 2]
    reference = planes[int(np.argmax(certainty))]
    pivot = certainty @ planes.centroid / certainty.sum()
    pivot = pivot - reference.heights_m(pivot) * reference.normal
    values = np.column_stack([_angles(planes.normal, reference), _heights_along(planes, pivot, reference.normal)])
    information = np.linalg.inv(_carried(_to_axes(planes, reference.axes, pivot), planes.covariance))
    weights = np.ones(len(values))
    for _ in range(_ROBUST_STEPS):
        total = np.einsum("n,nij->ij", weights, information)
        mean = np.linalg.solve(total, np.einsum("n,nij,nj->i", weights, information, values))
        residual = values - mean
        sigmas = np.sqrt(np.einsum("ni,nij,nj->n", residual, information, residual))
        if sigmas.max() <= _HUBER_DEVIATION and weights.min() == 1.0:
            break
        weights = _HUBER_DEVIATION / np.maximum(sigmas, _HUBER_DEVIATION)
    covariance = np.linalg.inv(total) * max(1.0, len(values) / independent)
    return _retracted(reference, pivot, mean, covariance)


def _angles(normal: Vector, reference: PlaneEstimate) -> Vector:
    """(alpha, beta) [..., 2] rad that turn the reference's normal into `normal` [..., 3], to first order."""
    tangential = np.einsum("...kj,...j->...k", reference.axes, normal)
    cosine = np.maximum(np.sum(normal * reference.normal, axis=-1, keepdims=True), 1e-3)
    return np.stack([-tangential[..., 1], tangential[..., 0]], axis=-1) / cosine


def _heights_along(planes: PlaneEstimate, point: Vector, direction: Vector) -> Vector:
    """How far [N] m along `direction` [3] from `point` [3] the planes lie."""
    return -planes.heights_m(point) / np.maximum(planes.normal @ direction, 1e-3)


def _to_axes(planes: PlaneEstimate, axes: Vector, place: Vector) -> Vector:
    """[..., 3, 3] from a plane's own error parameters to those about other tangents [..., 2, 3] at a place [..., 3]."""
    turn = np.einsum("...ij,...kj->...ik", axes, planes.axes)
    along = np.einsum("...kj,...j->...k", planes.axes, place - planes.centroid)
    shape = np.broadcast_shapes(turn.shape[:-2], along.shape[:-1])
    result = np.zeros((*shape, 3, 3))
    result[..., :2, :2] = turn
    result[..., 2, 0], result[..., 2, 1], result[..., 2, 2] = along[..., 1], -along[..., 0], 1.0
    return result


def _carried(jacobian: Vector, covariance: Vector) -> Vector:
    return jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)


def _retracted(reference: PlaneEstimate, pivot: Vector, error: Vector, covariance: Vector) -> PlaneEstimate:
    """The reference plane, turned and lifted at the pivot by error (alpha, beta, delta), with that covariance."""
    first, second = reference.axes
    normal = reference.normal - error[0] * second + error[1] * first
    normal = normal / np.linalg.norm(normal)
    centroid = pivot + error[2] * reference.normal
    axes = tangent_axes(normal)
    turn = np.eye(3)
    turn[:2, :2] = axes @ reference.axes.T
    return PlaneEstimate(normal, np.asarray(-normal @ centroid), centroid, axes, _carried(turn, covariance))
