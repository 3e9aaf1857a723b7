"""Which segments of a view show which PGIs: gating (Eq. 5), projected overlap (Eq. 6), cost (Eq. 7), assignment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from tgslam.config.plane_settings import PlanesConfig
from tgslam.planes.estimate import PlaneEstimate, deviation_sigmas

Vector = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_OFFSET_M = 0.5  # epsilon of Eq. 5: nearer planes are compared as if they were this far from the camera
_FORBIDDEN = 1e6  # cost of a pair that must not be matched


@dataclass(frozen=True)
class Agreement:
    """How well planes fit reference planes; all arrays have the same shape."""

    angle_rad: Vector  # theta of Eq. 5
    offset_ratio: Vector  # Delta d of Eq. 5
    deviation_sigmas: Vector
    admitted: Mask  # passes the gate

    def __getitem__(self, key: Any) -> Agreement:
        """Some of the pairs."""
        return Agreement(self.angle_rad[key], self.offset_ratio[key], self.deviation_sigmas[key], self.admitted[key])

    def or_better(self, other: Agreement) -> Agreement:
        """Pair by pair the one of the two that passes the gate, or deviates less."""
        better = np.where(
            self.admitted == other.admitted, other.deviation_sigmas < self.deviation_sigmas, other.admitted
        )
        return Agreement(
            np.where(better, other.angle_rad, self.angle_rad),
            np.where(better, other.offset_ratio, self.offset_ratio),
            np.where(better, other.deviation_sigmas, self.deviation_sigmas),
            self.admitted | other.admitted,
        )


def gate(planes: PlaneEstimate, references: PlaneEstimate, position: Vector, config: PlanesConfig) -> Agreement:
    """Eq. 5 and a metric gate, for planes and references in one frame whose leading shapes broadcast.

    theta = arccos(n_i . n_g), Delta d = |d_i - d_g| / max(d_i, d_g, epsilon). With the sign of the normals, the two
    sides of a thin wall are half a turn apart. Offsets are taken from the camera at `position` [3], so that nothing
    depends on the origin of the frame, yet Delta d still grows without bound for a camera near the plane: it enters
    the cost, and what decides is the distance from the plane's centroid to the reference, in metres and in standard
    deviations of both.
    """
    cosine = np.sum(planes.normal * references.normal, axis=-1)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    own_m, reference_m = planes.heights_m(position), references.heights_m(position)
    largest = np.maximum(np.maximum(np.abs(own_m), np.abs(reference_m)), _LEAST_OFFSET_M)
    distance = np.abs(references.heights_m(planes.centroid))
    deviation = deviation_sigmas(planes, references)
    limits = config.expert.association
    admitted = (angle <= limits.max_angle_rad) & (distance <= limits.max_distance_m)
    admitted &= deviation <= limits.gate_sigmas
    return Agreement(angle, np.abs(own_m - reference_m) / largest, deviation, admitted)


@dataclass(frozen=True)
class Overlap:
    """How the masks of segments [S] and PGIs [G] meet in an image."""

    intersection: NDArray[np.int64]  # [S, G] samples in both masks
    iou: Vector  # [S, G] Eq. 6
    containment: Vector  # [S, G] intersection over the smaller mask: a PGI reaches farther than one view of it


def overlap(labels: NDArray[np.int32], segments: int, shown: list[NDArray[np.int64]]) -> Overlap:
    """Eq. 6 for the segment of each sample [M] (-1 = none) and, for each PGI, the samples that show it."""
    sizes = np.bincount(labels[labels >= 0], minlength=segments)[:, None]
    counts = [np.bincount(labels[chosen] + 1, minlength=segments + 1)[1:] for chosen in shown]
    intersection = np.array(counts, np.int64).reshape(len(shown), segments).T
    others = np.array([len(chosen) for chosen in shown], np.int64)[None, :]
    union = sizes + others - intersection
    return Overlap(
        intersection,
        intersection / np.maximum(union, 1),
        intersection / np.maximum(np.minimum(sizes, others), 1),
    )


def matching_cost(agreement: Agreement, iou: Vector, config: PlanesConfig) -> Vector:
    """Eq. 7: c = w_theta theta / theta_max + w_d Delta d / delta_max + w_o (1 - IoU).

    The middle term is at most w_d, and at least w_d times the share of its gate that the deviation takes: surfaces
    a few centimetres apart differ little in Delta d.
    """
    limits = config.expert.association
    metric = agreement.deviation_sigmas / limits.gate_sigmas
    offset = np.minimum(np.maximum(agreement.offset_ratio / limits.max_offset_ratio, metric), 1.0)
    w_theta, w_d, w_o = limits.matching_weights
    return w_theta * agreement.angle_rad / limits.max_angle_rad + w_d * offset + w_o * (1.0 - iou)


def assign(cost: Vector, allowed: Mask) -> list[tuple[int, int]]:
    """Pairs (row, column) of the one-to-one assignment with most allowed pairs, and least cost among those."""
    if cost.size == 0:
        return []
    rows, columns = linear_sum_assignment(np.where(allowed, cost, _FORBIDDEN))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if allowed[i, j]]
