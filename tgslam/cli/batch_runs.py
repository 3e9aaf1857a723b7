"""`tgslam batch`: many recordings, in processes here or on a Dask cluster, and one table of them."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from tgslam.bench.batch import batch_table
from tgslam.bench.batch.list_file import Entry, names_of, read_list
from tgslam.bench.runs.jobs import Frames, Job, each_once, job_of
from tgslam.cli.inputs import parse_frames
from tgslam.cli.job_runs import add_run_options, add_settings_options, carry_out, folder_input
from tgslam.errors import EvaluationError, TgslamError
from tgslam.files.atomic import write_text
from tgslam.output.console import print_columns


def add_parser(commands: Any) -> argparse.ArgumentParser:
    """Add the command to the subparsers `commands`."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "batch",
        help="run many recordings",
        description="Run every recording of a list, some at a time here (--jobs) or on a Dask cluster (--scheduler), "
        "and print one table; it goes into --output as well, as Markdown and JSON. Runs that are finished there with "
        "the same settings are not done again.",
    )
    parser.add_argument(
        "list", type=Path, metavar="LIST",
        help="text with PATH [CONFIG] [SECTION.KEY=VALUE ...] a line, or YAML with path, config and set for each; "
        "relative paths count from its folder",
    )  # fmt: skip
    add_settings_options(parser)
    parser.add_argument(
        "--output", type=Path, default=Path("runs/batch"), metavar="DIR", help="folder (default: runs/batch)"
    )
    add_run_options(parser)
    parser.add_argument("--json", action="store_true", help="print everything as JSON instead of a table")
    return parser


def execute(args: argparse.Namespace) -> int:
    """Do the runs and print the table; whatever is wrong with the list is said before anything runs."""
    entries, frames = read_list(args.list), parse_frames(args.frames)
    names, parent = names_of(entries), args.output.resolve() / "runs"
    jobs = [_job(args, entry, name, frames, parent) for entry, name in zip(entries, names, strict=True)]
    args.output.mkdir(parents=True, exist_ok=True)
    wanted, failures = each_once(jobs), dict[Path, str]()
    try:
        carry_out(args, wanted, failures)
    finally:  # after Ctrl-C too
        found = {job.folder: metrics for job in wanted if (metrics := job.metrics()) is not None}
        table = batch_table.tabulate(names, jobs, found, failures)
        _write(args.output, table)
    _print(table, args.list, args.json)
    if failures:
        raise EvaluationError(f"{len(failures)} of {len(wanted)} runs failed; the table says why")
    return 0


def _job(args: argparse.Namespace, entry: Entry, name: str, frames: Frames, parent: Path) -> Job:
    """The run of a recording; the command line's `--set` counts before the list's own. Raises as `read_list` does."""
    try:
        input_ = folder_input(entry.path, entry.config or args.config, [*args.set, *entry.overrides], frames)
    except TgslamError as error:
        raise type(error)(f"{entry.where}: {error}") from error
    return job_of(name, input_, input_.config, frames, parent)


def _write(output: Path, table: dict[str, Any]) -> None:
    write_text(output / "batch.md", batch_table.markdown(table))
    write_text(output / "batch.json", json.dumps(table, indent=2, allow_nan=False) + "\n")


def _print(table: dict[str, Any], title: Path, as_json: bool) -> None:
    if as_json:
        print(json.dumps(table, indent=2, allow_nan=False))
        return
    print_columns(title.name, batch_table.header(table), batch_table.rows(table))
    for failure in batch_table.failed_runs(table):
        print(f"  failed: {failure}")
