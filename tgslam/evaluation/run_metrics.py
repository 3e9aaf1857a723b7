"""metrics.json: what a run counted while it ran, and what comparing its files with the input says."""

from __future__ import annotations

import logging
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from tgslam.config.input_settings import EvaluationConfig
from tgslam.datasets.source import RgbdSource
from tgslam.datasets.truth import SceneTruth
from tgslam.errors import EvaluationError, OutputError
from tgslam.evaluation.held_out import Show, view_metrics
from tgslam.evaluation.plane_metrics import (
    FLOATER_KEY,
    INSTANCE_KEYS,
    SUMMARY_KEYS,
    InstanceComparison,
    floater_share,
    summary_metrics,
)
from tgslam.evaluation.protocol import IMAGE_KEYS, TRAJECTORY_KEYS, Metrics, held_out_poses, trajectory_metrics
from tgslam.evaluation.surface_switches import SURFACE_KEY
from tgslam.evaluation.trajectory import align_poses
from tgslam.evaluation.truth_conventions import likely_mistake
from tgslam.output.log import read_log
from tgslam.output.planes_io import read_planes
from tgslam.output.ply import read_map
from tgslam.output.run_folder import RunFolder
from tgslam.output.trajectory_io import read_trajectory
from tgslam.types import FrameReport, FrameStatus, Gaussians, Matrix4, Plane, Trajectory

_log = logging.getLogger(__name__)

METRIC_KEYS = (
    *("state", "frames", "frames_skipped", "frames_lost", "tracked_fraction"),
    *("keyframes", "gaussians", *SUMMARY_KEYS, "closures"),
    *("wall_s", "fps", "peak_rss_mb", "device", "seed"),
    *TRAJECTORY_KEYS,
    *IMAGE_KEYS,
    *INSTANCE_KEYS,
    SURFACE_KEY,
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
        "frames_lost": fates[FrameStatus.LOST] + fates[FrameStatus.APART],
        "tracked_fraction": used / len(reports) if reports else None,
        "keyframes": sum(report.is_keyframe for report in reports),
        "gaussians": reports[-1].gaussians if reports else 0,
        "closures": next((r.closures for r in reversed(reports) if r.closures is not None), None),  # skipped: unknown
        "stage_s": dict(stage_s),
    }


def evaluate_run(
    folder: RunFolder,
    config: EvaluationConfig,
    source: RgbdSource | None,
    groundtruth: Trajectory | None,
    make_show: Callable[[Gaussians, Sequence[Plane]], Show] | None,
    *,
    read_ahead: bool = False,
    stop_requested: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Every metric that the files of a run and its input give: the one way for both `run` and `eval`.

    make_show: makes the function that renders the map and reads off which of these planes it shows; None leaves the
        metrics of images and of what they show null, as no source does.
    read_ahead: as in `read_frames`.
    Raises OutputError when the run was cut off before it wrote its trajectory, or a file of it is damaged, and
    EvaluationError when the input has changed since.
    """
    if not folder.trajectory.exists():
        raise OutputError(f"{folder.path}: this run did not come to its end: it has no {folder.trajectory.name}")
    run = _results(folder)
    metrics: dict[str, Any] = {
        **counts(run.reports),
        "keyframes": len(run.keyframes),
        "gaussians": len(run.gaussians),
        **({} if run.planes is None else summary_metrics(run.planes)),
    }
    if groundtruth is not None:
        metrics |= trajectory_metrics(run.every_frame, run.keyframes, groundtruth, config)
        mistake = likely_mistake(run.every_frame, groundtruth, config.truth_tolerance_s)
        if mistake is not None:
            _log.warning("the ground truth fits the run badly, and would fit well otherwise: %s", mistake)
    if source is not None and make_show is not None:
        poses = _poses(folder, run, source, config.holdout_interval)
        truth = source.truth()
        instances = None if truth is None or not run.planes else InstanceComparison(truth)
        show = make_show(run.gaussians, run.planes or ())
        metrics |= view_metrics(source, poses, show, instances, read_ahead=read_ahead, stop_requested=stop_requested)
        known = None if stop_requested() else truth
        metrics |= _scene_metrics(run, source, known, instances, config.truth_tolerance_s)
    return metrics


@dataclass(frozen=True)
class _Results:
    """What a run has written."""

    reports: list[FrameReport]
    every_frame: Trajectory
    keyframes: Trajectory
    gaussians: Gaussians
    planes: tuple[Plane, ...] | None  # None: the file is not there


def _results(folder: RunFolder) -> _Results:
    return _Results(
        reports=read_log(folder.log),
        every_frame=read_trajectory(folder.trajectory),
        keyframes=read_trajectory(folder.keyframes),
        gaussians=read_map(folder.map),
        planes=read_planes(folder.planes) if folder.planes.exists() else None,
    )


def _poses(folder: RunFolder, run: _Results, source: RgbdSource, interval: int) -> list[tuple[int, Matrix4]]:
    """Those of the held-out frames. Raises EvaluationError for a source or a trajectory that is not the run's."""
    if len(run.reports) > len(source):
        raise EvaluationError(
            f"{source.name} has {len(source)} frames now, but this run saw {len(run.reports)}; restore its input"
        )
    try:
        return held_out_poses(run.reports, run.every_frame, interval)
    except EvaluationError as error:
        raise EvaluationError(f"{folder.trajectory}: {error}") from error


def _scene_metrics(
    run: _Results,
    source: RgbdSource,
    truth: SceneTruth | None,
    instances: InstanceComparison | None,
    tolerance_s: float,
) -> Metrics:
    """What comparing with the scene itself gives; null for a recording, whose scene nobody knows."""
    metrics: Metrics = dict.fromkeys((*INSTANCE_KEYS, FLOATER_KEY))
    groundtruth = None if truth is None else source.groundtruth()  # in the truth's world, whatever else was compared
    if truth is None or groundtruth is None:
        return metrics
    T_alignment = _alignment(run.every_frame, groundtruth, tolerance_s)
    if T_alignment is not None:
        metrics[FLOATER_KEY] = floater_share(run.gaussians, truth, T_alignment)
    if instances is not None and run.planes:
        metrics |= instances.metrics(run.planes, T_alignment)
    return metrics


def _alignment(estimate: Trajectory, groundtruth: Trajectory, tolerance_s: float) -> Matrix4 | None:
    """Estimated world to true world, by whole poses; None where no pose says it."""
    try:
        return align_poses(estimate, groundtruth, tolerance_s)
    except EvaluationError:
        return None


def peak_rss_mb() -> float | None:
    """The most memory in MiB that this process has held so far; None where the system does not say."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024.0 * 1024.0 if sys.platform == "darwin" else 1024.0)
