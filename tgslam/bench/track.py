"""Tracking by stage: what a frame costs on its way to a pose, over the first frames of a sequence."""

from __future__ import annotations

from typing import Any

from tgslam.bench.timing import Samples, summary_ms
from tgslam.config.schema import Config
from tgslam.datasets.read_ahead import read_frames
from tgslam.datasets.source import RgbdSource
from tgslam.device.stopwatch import Stopwatch
from tgslam.errors import FrameError, TrackingError
from tgslam.output.progress import FrameObserver
from tgslam.slam import Slam
from tgslam.types import FrameReport, FrameStatus

WARM_UP = 2  # tracked frames: the first one compiles
_STEP = ("prepare", "track", "select")  # the system's stages that every tracked frame goes through
_MAP = "map"


def measure(source: RgbdSource, config: Config, observer: FrameObserver = lambda report: None) -> dict[str, Any]:
    """Run the system over all frames of `source`, and time the tracked ones from the second on.

    A step is all that the system does with a frame but mapping; `track` is split into the solver's own stages.
    Raises TrackingError when too few frames could be tracked.
    """
    system = Slam(source.camera, config)
    stopwatch = system.front_end.tracker.stopwatch = Stopwatch()
    samples, map_s, tracked = Samples(stopwatch), [], 0
    for frame in read_frames(source, ahead=False):
        stopwatch.seconds.clear()
        report = _process(system, frame)
        if report is None:
            continue
        observer(report)
        tracked += report.status is FrameStatus.TRACKED
        if report.status is FrameStatus.TRACKED and tracked > WARM_UP:
            samples.add(*_step(report, stopwatch))
            map_s += [report.stage_s[_MAP]] if _MAP in report.stage_s else []
    if not samples:
        raise TrackingError(f"{source.name}: {tracked} frames could be tracked, {WARM_UP + 1} are needed at least")
    return {
        "source": source.name,
        "width": source.camera.width,
        "height": source.camera.height,
        "solver": config.tracking.solver,
        "frames": len(samples),
        "gaussians": system.map.gaussians.count,
        **samples.report(rest="rest of track"),
        "keyframes": len(map_s),
        "map_ms": summary_ms(map_s) if map_s else None,
    }


def _process(system: Slam, frame: object) -> FrameReport | None:
    """The system's report; None for a frame that could not be read or used."""
    try:
        return None if isinstance(frame, FrameError) else system.process_frame(frame)  # type: ignore[arg-type]
    except FrameError:
        return None


def _step(report: FrameReport, stopwatch: Stopwatch) -> tuple[float, dict[str, float]]:
    """Seconds of the whole step, and by stage: the system's, with the solver's in place of `track`."""
    system_s = {name: report.stage_s[name] for name in _STEP}
    by_stage = {"prepare": system_s["prepare"], **stopwatch.seconds, "select": system_s["select"]}
    return sum(system_s.values()), by_stage
