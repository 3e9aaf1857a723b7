"""metrics.json: what a run counted while it ran, and what comparing its files with the input says."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from typing import Any

from tgslam.config.schema import EvaluationConfig
from tgslam.datasets.source import RgbdSource
from tgslam.errors import EvaluationError, OutputError
from tgslam.evaluation.instance_ids import ReadIds, rendered_ids
from tgslam.evaluation.planes import (
    FLOATER_KEY,
    INSTANCE_KEYS,
    SUMMARY_KEYS,
    floater_share,
    instance_metrics,
    summary_metrics,
)
from tgslam.evaluation.protocol import (
    IMAGE_KEYS,
    TRAJECTORY_KEYS,
    Render,
    held_out_poses,
    image_metrics,
    trajectory_metrics,
)
from tgslam.evaluation.trajectory import ate
from tgslam.output.log import read_log
from tgslam.output.planes_io import read_planes
from tgslam.output.ply import read_map
from tgslam.output.run_folder import RunFolder
from tgslam.output.trajectory_io import read_trajectory
from tgslam.types import FrameReport, FrameStatus, Gaussians, Matrix4, Plane, Trajectory

METRIC_KEYS = (
    *("state", "frames", "frames_skipped", "frames_lost", "tracked_fraction"),
    *("keyframes", "gaussians", *SUMMARY_KEYS, "closures"),
    *("wall_s", "fps", "peak_rss_mb", "device", "seed"),
    *TRAJECTORY_KEYS,
    *IMAGE_KEYS,
    *INSTANCE_KEYS,
    FLOATER_KEY,
    "stage_s",
)


def complete(metrics: dict[str, Any]) -> dict[str, Any]:
    """`metrics` with every key of metrics.json in its fixed order, null where there is no value."""
    return {key: metrics.get(key) for key in METRIC_KEYS}


def counts(reports: Sequence[FrameReport]) -> dict[str, Any]:
    """What a run's frame reports add up to: frames by fate, keyframes, Gaussians, seconds by stage."""
    fates = Counter(report.status for report in reports)
    stage_s: Counter[str] = Counter()
    for report in reports:
        stage_s.update(report.stage_s)
    used = fates[FrameStatus.INITIAL] + fates[FrameStatus.TRACKED]
    return {
        "frames": len(reports),
        "frames_skipped": fates[FrameStatus.SKIPPED],
        "frames_lost": fates[FrameStatus.LOST],
        "tracked_fraction": used / len(reports) if reports else None,
        "keyframes": sum(report.is_keyframe for report in reports),
        "gaussians": reports[-1].gaussians if reports else 0,
        "stage_s": dict(stage_s),
    }


def evaluate_run(
    folder: RunFolder,
    config: EvaluationConfig,
    source: RgbdSource | None,
    groundtruth: Trajectory | None,
    make_render: Callable[[], Render] | None,
    stop_requested: Callable[[], bool] = lambda: False,
    make_read_ids: Callable[[Render, Collection[int]], ReadIds] = rendered_ids,
) -> dict[str, Any]:
    """Every metric that the files of a run and its input give: the one way for both `run` and `eval`.

    make_render: makes the function that renders the map; None leaves the image metrics null, as no source does.
    make_read_ids: makes the function that reads plane ids, of the known ones, off the map.
    Raises OutputError when the run was cut off before it wrote its trajectory, or a file of it is damaged, and
    EvaluationError when the input has changed since.
    """
    if not folder.trajectory.exists():
        raise OutputError(f"{folder.path}: this run did not come to its end: it has no {folder.trajectory.name}")
    reports = read_log(folder.log)
    every_frame, keyframes = read_trajectory(folder.trajectory), read_trajectory(folder.keyframes)
    gaussians = read_map(folder.map)
    planes = read_planes(folder.planes) if folder.planes.exists() else ()
    metrics: dict[str, Any] = {**counts(reports), "keyframes": len(keyframes), "gaussians": len(gaussians)}
    if folder.planes.exists():
        metrics |= summary_metrics(planes)
    if groundtruth is not None:
        metrics |= trajectory_metrics(every_frame, keyframes, groundtruth, config)
    if source is not None and make_render is not None:
        if len(reports) > len(source):
            raise EvaluationError(
                f"{source.name} has {len(source)} frames now, but this run saw {len(reports)}; restore its input"
            )
        try:
            poses = held_out_poses(reports, every_frame, config.holdout_interval)
        except EvaluationError as error:
            raise EvaluationError(f"{folder.trajectory}: {error}") from error
        render = make_render()
        metrics |= image_metrics(source, poses, gaussians, render, stop_requested)
        read_ids = make_read_ids(render, [plane.id for plane in planes])
        metrics |= _scene_metrics(source, every_frame, config, planes, gaussians, poses, read_ids, stop_requested)
    return metrics


def _scene_metrics(
    source: RgbdSource,
    every_frame: Trajectory,
    config: EvaluationConfig,
    planes: Sequence[Plane],
    gaussians: Gaussians,
    poses: Sequence[tuple[int, Matrix4]],
    read_ids: ReadIds,
    stop_requested: Callable[[], bool],
) -> dict[str, Any]:
    """What comparing with the scene itself gives; null for a recording, whose scene nobody knows."""
    truth = source.truth()
    groundtruth = None if truth is None else source.groundtruth()  # in the truth's world, whatever else was compared
    if truth is None or groundtruth is None or stop_requested():
        return dict.fromkeys((*INSTANCE_KEYS, FLOATER_KEY))
    T_alignment = _alignment(every_frame, groundtruth, config.association_tolerance_s)
    return {
        **instance_metrics(planes, gaussians, poses, truth, T_alignment, read_ids, stop_requested),
        FLOATER_KEY: None if T_alignment is None else floater_share(gaussians, truth, T_alignment),
    }


def _alignment(estimate: Trajectory, groundtruth: Trajectory, tolerance_s: float) -> Matrix4 | None:
    """Estimated world to true world; None where too few poses say it."""
    try:
        return ate(estimate, groundtruth, tolerance_s).T_alignment
    except EvaluationError:
        return None


def peak_rss_mb() -> float | None:
    """The most memory in MiB that this process has held so far; None where the system does not say."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0 * 1024.0 if sys.platform == "darwin" else 1024.0)
