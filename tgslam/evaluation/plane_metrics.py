"""Metrics of planes: what a run says of its own, and how they compare with the true ones where a scene has any."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam.datasets.truth import SceneTruth
from tgslam.evaluation.panoptic import IdentitySwitches, IdImage, overlaps, panoptic, shown
from tgslam.geometry import transform_points
from tgslam.types import Gaussians, Matrix4, Plane

Metrics = dict[str, float | None]

SUMMARY_KEYS = ("planes", "plane_area_m2", "plane_rms_mm")
INSTANCE_KEYS = (
    *("plane_pq", "plane_frame_pq", "plane_miou", "plane_precision", "plane_recall"),
    *("plane_switches_per_100", "plane_normal_deg", "plane_normal_p95_deg", "plane_offset_mm"),
)
FLOATER_KEY = "floater_share"

MIN_AREA_M2 = 0.2  # true planes of which no frame shows more are void, smaller predicted ones no false positives
FLOATER_M = 0.05  # from the nearest true surface
_TAIL_PERCENT = 95.0  # the percentile that stands for the worst normals


def summary_metrics(planes: Sequence[Plane]) -> Metrics:
    """The values of `SUMMARY_KEYS`: number, area of all, and root mean square distance of their points, by area."""
    areas = np.array([plane.area_m2 for plane in planes])
    squares = np.array([plane.inlier_rms_m for plane in planes]) ** 2
    total = float(areas.sum())
    return {
        "planes": len(planes),
        "plane_area_m2": total if planes else None,
        "plane_rms_mm": 1000.0 * float(np.sqrt(areas @ squares / total)) if total > 0 else None,
    }


class InstanceComparison:
    """Compares the ids that the map shows in the held-out frames with the true labels.

    A plane counts when a frame shows `MIN_AREA_M2` of it, in all the frames that show enough of it to speak of. An
    estimated plane that is smaller may match, but is not held against the map when it does not.
    """

    def __init__(self, truth: SceneTruth) -> None:
        self._truth = truth
        self._frames: list[Counter[tuple[int, int]]] = []
        self._areas_m2 = np.zeros(len(truth.planes()))  # the most that a frame shows of each true plane

    def add(self, position: int, ids: IdImage) -> None:
        """Take the ids [H, W] that the map shows at the pose of the frame at that position of the source."""
        self._frames.append(overlaps(self._truth.labels(position), ids))
        self._areas_m2 = np.maximum(self._areas_m2, self._truth.seen_areas_m2(position))

    def metrics(self, planes: Sequence[Plane], T_alignment: Matrix4 | None) -> Metrics:
        """The values of `INSTANCE_KEYS` for the map's planes; null without a frame.

        T_alignment: estimated world to true world, as the poses align; without it the planes' errors are null.
        """
        if not self._frames:
            return dict.fromkeys(INSTANCE_KEYS)
        large = frozenset(np.flatnonzero(self._areas_m2 >= MIN_AREA_M2).tolist())
        minor = frozenset(plane.id for plane in planes if plane.area_m2 < MIN_AREA_M2)
        switches, pixels, qualities = IdentitySwitches(), Counter[tuple[int, int]](), []
        all_labels, all_ids = set[int](), set[int]()
        for found in self._frames:
            labels, ids = shown(found)
            labels &= large
            switches.add(found, labels)
            qualities.append(panoptic(found, labels, ids, minor).quality)
            pixels += found
            all_labels |= labels
            all_ids |= ids
        score = panoptic(pixels, all_labels, all_ids, minor)
        defined = [quality for quality in qualities if quality is not None]
        true_planes = self._truth.planes()
        return {
            **dict.fromkeys(INSTANCE_KEYS),
            "plane_pq": score.quality,
            "plane_frame_pq": float(np.mean(defined)) if defined else None,
            "plane_miou": score.mean_iou,
            "plane_precision": score.precision,
            "plane_recall": score.recall,
            "plane_switches_per_100": switches.per_100_frames,
            **({} if T_alignment is None else plane_errors(planes, score.matches, true_planes, T_alignment)),
        }


def plane_errors(
    planes: Sequence[Plane], matches: Mapping[int, int], true_planes: NDArray[np.float64], T_alignment: Matrix4
) -> Metrics:
    """Errors of planes [P] against the true planes [L, 4] that they match (label -> id), in the true world.

    Normals: mean and 95th percentile of the angle in degrees. Offset: mean distance in mm of the planes' centroids from
    the true planes, which does not depend on where the origin is. Null without a match.
    """
    by_id = {plane.id: plane for plane in planes}
    pairs = [(by_id[id_], true_planes[label]) for label, id_ in matches.items() if id_ in by_id]
    if not pairs:
        return dict.fromkeys(("plane_normal_deg", "plane_normal_p95_deg", "plane_offset_mm"))
    truth = np.stack([true for _, true in pairs])
    normals = np.stack([plane.normal_w for plane, _ in pairs]) @ T_alignment[:3, :3].T
    centroids = transform_points(T_alignment, np.stack([plane.centroid_w for plane, _ in pairs]))
    sine = np.linalg.norm(np.cross(normals, truth[:, :3]), axis=1)
    angles_deg = np.degrees(np.arctan2(sine, np.sum(normals * truth[:, :3], axis=1)))
    distances_m = np.abs(np.sum(centroids * truth[:, :3], axis=1) + truth[:, 3])
    return {
        "plane_normal_deg": float(angles_deg.mean()),
        "plane_normal_p95_deg": float(np.percentile(angles_deg, _TAIL_PERCENT)),
        "plane_offset_mm": 1000.0 * float(distances_m.mean()),
    }


def floater_share(gaussians: Gaussians, truth: SceneTruth, T_alignment: Matrix4) -> float | None:
    """Share of the Gaussians whose centres are more than `FLOATER_M` from every true surface; None for an empty map."""
    if not len(gaussians):
        return None
    centres = transform_points(T_alignment, gaussians.mean.astype(np.float64))
    return float(np.mean(truth.surface_distance_m(centres) > FLOATER_M))
