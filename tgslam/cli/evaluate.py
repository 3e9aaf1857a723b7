"""`tgslam eval`: the metrics of an earlier run, computed again from its files and its input."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import Any

from tgslam.cli import engine
from tgslam.cli.inputs import can_read_ahead, groundtruth_to_compare, open_again
from tgslam.cli.summary import print_metrics
from tgslam.config.schema import Config
from tgslam.datasets.groundtruth import read_groundtruth
from tgslam.datasets.source import RgbdSource
from tgslam.errors import EvaluationError, TgslamError
from tgslam.evaluation.run_metrics import complete, evaluate_run
from tgslam.output.run_folder import RunFolder, RunRecord, RunState
from tgslam.types import Trajectory

_log = logging.getLogger(__name__)


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Add the command to the subparsers `commands`."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "eval",
        help="compute the metrics of a run again",
        description="Compare a run's trajectory with ground truth and its map with held-out frames, "
        "and update its metrics.json.",
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    parser.add_argument("--groundtruth", type=Path, metavar="FILE", help="TUM text (default: that of the input)")
    engine.add_device_option(parser)
    return parser


def execute(args: argparse.Namespace) -> int:
    """Evaluate, print the table, and update metrics.json: what only the run itself could measure stays."""
    folder = RunFolder.open(args.run)
    record, config = folder.read_record(), folder.read_config()
    device = engine.start_device(args.device)
    source = _open_source(config, record, required=args.groundtruth is None)
    groundtruth = _groundtruth(args.groundtruth, config, source)
    earlier = folder.read_metrics()
    found = evaluate_run(
        folder,
        config.evaluation,
        source,
        groundtruth,
        lambda gaussians, planes: engine.make_show(record.camera, gaussians, planes, config),
        read_ahead=can_read_ahead(source),
    )
    if args.groundtruth is not None and found["ate_rmse_all_cm"] is None:
        raise EvaluationError(f"{args.groundtruth}: cannot be compared with {folder.trajectory}; see the warning above")
    found["stage_s"] = {**found["stage_s"], **(earlier.get("stage_s") or {})}
    state = RunState.INTERRUPTED if record.state is RunState.INTERRUPTED else RunState.FINISHED
    metrics = complete({"state": state.value, "device": device, "seed": config.seed, **earlier, **found})
    folder.write_metrics(metrics)
    print_metrics(str(folder.path), metrics)
    return 0


def _groundtruth(file: Path | None, config: Config, source: RgbdSource | None) -> Trajectory | None:
    if file is not None:
        return read_groundtruth(file)
    return None if source is None else groundtruth_to_compare(config, source)


def _open_source(config: Config, record: RunRecord, required: bool) -> RgbdSource | None:
    """The input of the run; None when it is gone and not required."""
    try:
        return open_again(config, record)
    except TgslamError as error:
        if required:
            raise
        _log.warning("the input of the run cannot be opened, so the image metrics stay as they are: %s", error)
        return None
