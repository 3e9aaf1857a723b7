"""`tgslam run`: frames in; a run folder with trajectory, map and metrics out."""

from __future__ import annotations

import argparse
import dataclasses
import logging
import time
from datetime import datetime
from pathlib import Path
from typing import Any

from tgslam import __version__, pipeline
from tgslam.cli import engine
from tgslam.cli.inputs import (
    Frames,
    add_input_options,
    can_read_ahead,
    groundtruth_to_compare,
    input_as_recorded,
    known_poses,
    opened,
    parse_frames,
    resolve_config,
    settings_of,
)
from tgslam.cli.interrupt import StopRequest
from tgslam.cli.options import natural
from tgslam.cli.summary import print_metrics
from tgslam.config.schema import Config
from tgslam.datasets.edge_alignment import warn_of_misalignment
from tgslam.datasets.live.live_source import LiveSource
from tgslam.datasets.source import RgbdSource
from tgslam.errors import TgslamError
from tgslam.evaluation.run_metrics import complete, evaluate_run, peak_rss_mb
from tgslam.output.console import error_console
from tgslam.output.progress import frame_progress
from tgslam.output.run_folder import RunFolder, RunRecord, RunState, fresh_folder
from tgslam.types import Trajectory

_log = logging.getLogger(__name__)
_EXIT_INTERRUPTED = 130
_BUDGETS = {"fast": 0.5, "normal": 1.0, "high": 5.0}  # of refinement, by --quality


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Add the command to the subparsers `commands`."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "run",
        help="reconstruct a sequence (without arguments: the built-in room)",
        description="Track the camera through an RGB-D sequence and build its Gaussian map. "
        "Ctrl-C ends the run after the current frame and saves everything so far.",
    )
    add_input_options(parser, live=True)
    parser.add_argument("--output", type=Path, metavar="DIR", help="run folder (default: a new one under runs/)")
    parser.add_argument(
        "--poses",
        metavar="FILE",
        help="camera-to-world poses that are known, as text or NumPy array; `recording`: those that came with it",
    )
    parser.add_argument(
        "--poses-use",
        choices=("fixed", "prior"),
        help="fixed: build the map only; prior: tracking starts there (default: fixed, or as poses.use says)",
    )
    parser.add_argument(
        "--quality",
        choices=tuple(_BUDGETS),
        help="how much time the map's sharpness is given: mapping.budget of "
        + ", ".join(f"{budget:g}" for budget in _BUDGETS.values()),
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the run that --output holds")
    parser.add_argument("--no-final", action="store_true", help="leave out the final refinement of the map")
    engine.add_device_option(parser)
    parser.add_argument(
        "--threads", type=natural, default=0, metavar="N", help="CPU threads (default: 0, which is all cores)"
    )
    return parser


def execute(args: argparse.Namespace) -> int:
    """Do the run and evaluate it; 130 when it was stopped early."""
    started_s = time.perf_counter()
    budget = [] if args.quality is None else [f"mapping.budget={_BUDGETS[args.quality]:g}"]
    config = resolve_config(args.config, args.input, [*settings_of(args), *budget])
    config = _with_poses(config, args.poses, args.poses_use)
    frames = parse_frames(args.frames)
    device = engine.start_device(args.device, args.threads)
    with opened(config, args.input, frames) as source:
        metrics, folder = _recorded(args, config, source, frames)
    metrics |= {"device": device, "seed": config.seed}
    metrics |= {"wall_s": time.perf_counter() - started_s, "peak_rss_mb": peak_rss_mb()}
    folder.write_metrics(complete(metrics))
    folder.write_record(dataclasses.replace(folder.read_record(), state=RunState(metrics["state"])))
    print_metrics(f"{source.name} -> {folder.path}", complete(metrics))
    if metrics["state"] == RunState.INTERRUPTED.value:
        again = _readable_again(source)
        of_all = "" if again is None else f" of {len(again)}"
        _log.warning("stopped after %d%s frames; all of them are saved", metrics["frames"], of_all)
        return _EXIT_INTERRUPTED
    return 0


def _recorded(
    args: argparse.Namespace, config: Config, source: RgbdSource | LiveSource, frames: Frames
) -> tuple[dict[str, Any], RunFolder]:
    """Do the run in a folder of its own; run.json says when it failed."""
    poses = known_poses(config, source)
    again = _readable_again(source)
    if again is not None and config.dataset.format != "synthetic":  # whose depth lies where colour does
        warn_of_misalignment(again)
    path = args.output or fresh_folder(Path("runs"), source.name, datetime.now())
    folder = RunFolder.create(path, args.overwrite)
    record = RunRecord(
        tgslam=__version__,
        state=RunState.RUNNING,
        source=source.name,
        input=input_as_recorded(args.input),
        frames=frames,
        camera=source.camera,
    )
    folder.write_record(record)
    folder.write_config(config)
    try:
        with StopRequest() as stop:
            return _run_and_evaluate(args, config, source, poses, folder, stop), folder
    except BaseException as error:
        _mark_failed(folder, record, error)
        raise


def _run_and_evaluate(
    args: argparse.Namespace,
    config: Config,
    source: RgbdSource | LiveSource,
    poses: pipeline.Poses | None,
    folder: RunFolder,
    stop: StopRequest,
) -> dict[str, Any]:
    """The metrics of the run, from the files that it wrote; images are left out once the user asked to stop."""
    system = engine.make_system(source.camera, config)
    again = _readable_again(source)
    with frame_progress(None if again is None else len(again), error_console(), args.quiet) as observer:
        summary = pipeline.run(
            source,
            system,
            folder,
            poses=poses,
            read_ahead=can_read_ahead(again),
            refine=not args.no_final,
            observer=observer,
            stop_requested=stop,
        )
    start_s = time.perf_counter()
    metrics = evaluate_run(
        folder,
        config.evaluation,
        again,
        _groundtruth(config, source),
        None if stop() else lambda gaussians, planes: engine.make_show(source.camera, gaussians, planes, config),
        read_ahead=can_read_ahead(again),
        stop_requested=stop,
    )
    if again is None:
        _log.warning("the image metrics are null: frames that came live cannot be read again")
    metrics["stage_s"] |= {
        "read": summary.read_s,
        "finish": summary.finish_s,
        "evaluate": time.perf_counter() - start_s,
    }
    metrics["fps"] = len(summary.reports) / summary.loop_s if summary.reports else None
    metrics["state"] = (RunState.INTERRUPTED if stop() else RunState.FINISHED).value
    return metrics


def _readable_again(source: RgbdSource | LiveSource) -> RgbdSource | None:
    """The source, if its frames can be counted before the run and compared after it."""
    return None if isinstance(source, LiveSource) else source


def _with_poses(config: Config, file: str | None, use: str | None) -> Config:
    """The settings with what `--poses` and `--poses-use` say."""
    poses = config.poses if file is None else dataclasses.replace(config.poses, file=file)
    if use is not None or (file is not None and poses.use == "none"):
        poses = dataclasses.replace(poses, use=use or "fixed")
    return dataclasses.replace(config, poses=poses)


def _groundtruth(config: Config, source: RgbdSource | LiveSource) -> Trajectory | None:
    """The ground truth, opened only now that tracking is over; the run stands without it."""
    try:
        return groundtruth_to_compare(config, source)
    except TgslamError as error:
        _log.warning("the trajectory metrics are null: %s", error)
        return None


def _mark_failed(folder: RunFolder, record: RunRecord, error: BaseException) -> None:
    """Say in run.json that the run failed, if that can still be written."""
    try:
        folder.write_record(dataclasses.replace(record, state=RunState.FAILED, message=f"{error}"))
    except OSError as second:
        _log.warning("%s could not be updated: %s", folder.record, second)
