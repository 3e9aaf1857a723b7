"""One run: reads frames, hands them to the system, writes what comes out. It knows no algorithm and no ground truth."""

from __future__ import annotations

import contextlib
import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

from tgslam.datasets.live.live_source import LiveSource
from tgslam.datasets.read_ahead import read_frames
from tgslam.datasets.source import RgbdSource
from tgslam.errors import FrameError, TrackingError
from tgslam.output.log import FrameLog
from tgslam.output.ply import write_map
from tgslam.output.progress import FrameObserver
from tgslam.output.run_folder import RunFolder
from tgslam.output.run_results import Found, write_results
from tgslam.output.trajectory_io import write_trajectory
from tgslam.types import Frame, FrameReport, FrameStatus, Matrix4

_log = logging.getLogger(__name__)
_MAX_WARNINGS = 5  # skipped or lost frames that are named; log.jsonl has all


class System(Found, Protocol):
    """What a run needs of the SLAM system."""

    def process_frame(self, frame: Frame, T_wc: Matrix4 | None = None) -> FrameReport:
        """Take the next frame of the sequence, with its pose [4, 4] where the user knows it.

        Raises FrameError, unchanged, for one that it cannot use.
        """

    def finish(self) -> None:
        """Refine the map once all frames are in."""


class Poses(Protocol):
    """Poses that the user knows."""

    def at(self, index: int, timestamp_s: float) -> Matrix4 | None:
        """T_wc [4, 4] of a frame, None where it is not known."""


class _NoPoses:
    def at(self, index: int, timestamp_s: float) -> Matrix4 | None:
        return None


@dataclass(frozen=True)
class Summary:
    """How a run went."""

    reports: list[FrameReport]  # one a frame
    loop_s: float  # wall time of the frame loop
    finish_s: float  # wall time of the final refinement
    read_s: float  # of the loop: time spent waiting for frames
    interrupted: bool  # stopped on request before the last frame


def run(
    source: RgbdSource | LiveSource,
    system: System,
    folder: RunFolder,
    *,
    poses: Poses | None = None,
    read_ahead: bool = True,
    refine: bool = True,
    observer: FrameObserver = lambda report: None,
    stop_requested: Callable[[], bool] = lambda: False,
) -> Summary:
    """Feed every frame to `system`, refine, and write trajectories, planes and map.ply; log.jsonl grows on.

    poses: of the frames, where the user knows them.
    read_ahead: decode the next frame in a thread meanwhile; only for a source that does not use the kernels itself.
    refine: call `finish`; never done after a request to stop.
    stop_requested: asked before each frame; when true, the run ends there and writes what it has.
    Raises TrackingError when no frame at all could be tracked, and DatasetError when a live source gives none. When
    anything is raised, there is no map.ply, but the poses and the map up to there are kept as partial_trajectory.txt
    and partial_map.ply where that is possible.
    """
    try:
        summary = _frame_loop(source, system, folder, poses or _NoPoses(), read_ahead, observer, stop_requested)
        _check_tracked(source.name, summary.reports)
        if refine and not summary.interrupted:
            start_s = time.perf_counter()
            system.finish()
            summary = replace(summary, finish_s=time.perf_counter() - start_s)
        write_results(folder, system)
    except Exception:
        _save_partial(system, folder)
        raise
    return summary


def _frame_loop(
    source: RgbdSource | LiveSource,
    system: System,
    folder: RunFolder,
    poses: Poses,
    read_ahead: bool,
    observer: FrameObserver,
    stop_requested: Callable[[], bool],
) -> Summary:
    reports: list[FrameReport] = []
    read_s = 0.0
    start_s = waiting_since_s = time.perf_counter()
    with FrameLog(folder.log) as log:
        for position, item in enumerate(_frames(source, read_ahead, stop_requested)):
            read_s += time.perf_counter() - waiting_since_s
            if stop_requested():
                interrupted = True
                break
            report = _report(position, item, system, poses, gaussians=reports[-1].gaussians if reports else 0)
            reports.append(_with_dropped(report, source))
            log.append(reports[-1])
            observer(reports[-1])
            _warn(reports)
            waiting_since_s = time.perf_counter()
        else:
            interrupted = isinstance(source, LiveSource) and stop_requested()  # as it waited for a frame
    loop_s = time.perf_counter() - start_s
    return Summary(reports, loop_s=loop_s, finish_s=0.0, read_s=read_s, interrupted=interrupted)


def _frames(
    source: RgbdSource | LiveSource, read_ahead: bool, stop_requested: Callable[[], bool]
) -> Iterator[Frame | FrameError]:
    return source.frames(stop_requested) if isinstance(source, LiveSource) else read_frames(source, read_ahead)


def _with_dropped(report: FrameReport, source: RgbdSource | LiveSource) -> FrameReport:
    """Of a live source the log also says how many frames have been dropped so far."""
    if not isinstance(source, LiveSource):
        return report
    return replace(report, measures={**report.measures, "dropped": float(source.dropped)})


def _report(position: int, item: Frame | FrameError, system: System, poses: Poses, gaussians: int) -> FrameReport:
    """What became of one frame. One that could not be read has no time, and its position in the source as its index."""
    if isinstance(item, FrameError):
        return _skipped(position, math.nan, item, gaussians)
    try:
        return system.process_frame(item, poses.at(item.index, item.timestamp_s))
    except FrameError as error:
        return _skipped(item.index, item.timestamp_s, error, gaussians)


def _skipped(index: int, timestamp_s: float, error: FrameError, gaussians: int) -> FrameReport:
    return FrameReport(
        index=index,
        timestamp_s=timestamp_s,
        status=FrameStatus.SKIPPED,
        is_keyframe=False,
        gaussians=gaussians,
        stage_s={},
        measures={},
        message=str(error),
    )


def _warn(reports: list[FrameReport]) -> None:
    """Say why the last frame was skipped or lost, for the first few of a run."""
    report = reports[-1]
    if report.status not in (FrameStatus.SKIPPED, FrameStatus.LOST):
        return
    count = sum(earlier.status is report.status for earlier in reports)
    if count <= _MAX_WARNINGS:
        _log.warning("frame %d is %s: %s", report.index, report.status.value, report.message or "no reason given")
    if count == _MAX_WARNINGS:
        _log.warning("further %s frames are named in log.jsonl only", report.status.value)


def _check_tracked(name: str, reports: list[FrameReport]) -> None:
    used = sum(report.status in (FrameStatus.INITIAL, FrameStatus.TRACKED) for report in reports)
    tracked = sum(report.status is FrameStatus.TRACKED for report in reports)
    if reports and (used == 0 or (tracked == 0 and len(reports) > 1)):
        last = next((report.message for report in reversed(reports) if report.message), "no reason given")
        skipped = all(report.status is FrameStatus.SKIPPED for report in reports)
        advice = "" if skipped else "; check dataset.depth_scale and the camera's fx, fy, cx, cy"
        raise TrackingError(f"{name}: none of {len(reports)} frames could be tracked; the last one: {last}{advice}")


def _save_partial(system: System, folder: RunFolder) -> None:
    """Keep what there is of a run that failed; the failure itself is what the user hears about."""
    with contextlib.suppress(Exception):  # whatever went wrong may have left the system in any state
        write_trajectory(folder.partial_trajectory, system.trajectory())
    with contextlib.suppress(Exception):
        write_map(folder.partial_map, system.gaussians())
