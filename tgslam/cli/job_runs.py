"""What commands share that do many runs: their options, and how the runs are carried out."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence
from pathlib import Path

from tgslam.bench.runs.jobs import Frames, Input, Job
from tgslam.cli.inputs import open_frames, resolve_config
from tgslam.cli.options import add_thread_count, positive
from tgslam.output.console import error_console
from tgslam.output.progress import step_progress

_log = logging.getLogger(__name__)


def add_settings_options(parser: argparse.ArgumentParser) -> None:
    """`--config`, `--set` and `--frames`, of all runs."""
    parser.add_argument("--config", type=Path, metavar="CONFIG", help="YAML file, or a packaged one by name")
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="override a setting; repeatable"
    )
    parser.add_argument("--frames", metavar="START:STOP:STEP", help="which frames, as a Python slice (default: all)")


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """`--jobs`, `--scheduler` and `--threads`: where the runs are done."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs", type=positive, default=1, metavar="N", help="runs at a time, which share the cores (default: 1)"
    )
    where.add_argument(
        "--scheduler", metavar="ADDRESS",
        help="of a Dask scheduler, whose workers do the runs; they see inputs and output at the same paths",
    )  # fmt: skip
    add_thread_count(parser)


def folder_input(path: Path, config: Path | None, overrides: Sequence[str], frames: Frames) -> Input:
    """A recording with its settings, opened once to see that it can be. Raises ConfigError and DatasetError."""
    settings, folder = resolve_config(config, path, overrides), path.resolve()
    open_frames(settings, folder, frames)
    return Input(folder.name, folder, settings)


def carry_out(args: argparse.Namespace, jobs: Sequence[Job], failures: dict[Path, str]) -> None:
    """Do what is not finished yet, and note in `failures` what fails, by the run's folder."""
    from tgslam.bench.runs import workers

    todo = [job for job in jobs if job.metrics() is None]
    if len(todo) < len(jobs):
        _log.info("%d of %d runs are finished already", len(jobs) - len(todo), len(jobs))
    if not todo:
        return

    def ended(job: Job, failure: str | None) -> None:
        if failure is None and job.metrics() is None:
            failure = f"it ended well, but {job.folder} is not here: workers need --output at the same path"
        if failure is not None:
            failures[job.folder] = failure
            _log.warning("%s failed: %s", job.label, failure)

    threads = args.threads or 0
    with step_progress("run", len(todo), error_console(), args.quiet) as step:
        if args.scheduler is not None:
            workers.run_on_cluster(todo, args.scheduler, threads, step, ended)
        else:
            workers.run_here(todo, args.jobs, threads, step, ended)
