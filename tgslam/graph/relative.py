"""The motion between two keyframes from the planes that both see.

Two planes leave it free along their common line, parallel ones along both tangents and about the normal. Each view
enters with its own fit; the fused plane of the PGI contains all views, and would count this one again with every edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tgslam.config.graph_settings import AcceptanceSettings
from tgslam.planes.estimate import PlaneEstimate, difference
from tgslam.relative_motion import Measurement, Quadratic, solve

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class PlanePairs:
    """Matched planes [N] as the keyframes i and j saw them, each in its own camera's frame."""

    in_i: PlaneEstimate
    in_j: PlaneEstimate

    def __len__(self) -> int:
        return len(self.in_i.normal)


def of_planes(pairs: PlanePairs, T_ji: Vector) -> Quadratic:
    """What matched planes say near T_ji: rotation by their normals, translation by their offsets."""
    moved = pairs.in_i.transformed(T_ji)
    error, covariance = difference(pairs.in_j, moved)
    lever = np.cross(moved.normal, pairs.in_j.centroid)
    jacobian = np.zeros((len(pairs), 3, 6))
    jacobian[:, :2, :3] = -moved.axes
    jacobian[:, 2, :3], jacobian[:, 2, 3:] = lever, -moved.normal
    weighted = np.linalg.solve(covariance, np.concatenate([jacobian, error[:, :, None]], axis=2))
    A = np.einsum("nki,nkj->ij", jacobian, weighted[:, :, :6])
    b = np.einsum("nki,nk->i", jacobian, weighted[:, :, 6])
    return Quadratic(A, b, float(np.sum(error * weighted[:, :, 6])), error.size)


def measure(pairs: PlanePairs, prior_T_ji: Vector, limits: AcceptanceSettings) -> Measurement:
    """The motion from planes alone, free directions as in the prior [4, 4]. Gauss-Newton from there."""
    return solve(lambda T_ji: of_planes(pairs, T_ji), prior_T_ji, limits)
