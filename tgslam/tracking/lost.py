"""When a tracked pose is not to be believed."""

from __future__ import annotations

from tgslam.config.schema import TrackingConfig


def evidence_against(measures: dict[str, float], config: TrackingConfig) -> str:
    """What speaks against a pose, "" if nothing does.

    measures: overlap (live pixels that meet the map), inlier_ratio (of them, within three sigma), condition (of the
    pose's information matrix).
    """
    if measures["overlap"] < config.lost_overlap:
        return f"only {measures['overlap']:.0%} of the frame meets the map"
    if measures["inlier_ratio"] < config.lost_inlier_ratio:
        return f"only {measures['inlier_ratio']:.0%} of the matched pixels lie within three sigma"
    if not measures["condition"] < config.lost_condition:
        return f"the pose is not determined (condition number {measures['condition']:.1e})"
    return ""
