"""`tgslam bench paper`: the paper's tables beside what runs here reach on whatever of its recordings is there."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tgslam.bench.ablation.studies import keys_of
from tgslam.bench.paper import side_by_side
from tgslam.bench.paper.figures import PaperTable, Row, paper_figures
from tgslam.bench.paper.recordings_found import find_sequences, shortness
from tgslam.bench.runs.jobs import Frames, Input, Job, each_once, job_of
from tgslam.cli.identity_frame import measure_identity
from tgslam.cli.inputs import parse_frames
from tgslam.cli.job_runs import add_run_options, add_settings_options, carry_out, folder_input
from tgslam.cli.options import natural, size
from tgslam.config.loader import override
from tgslam.datasets import open_stored
from tgslam.errors import ConfigError, DatasetError
from tgslam.files.atomic import write_text

_FIGURE = "fig6"
_NAMES = ("1", "2", "3", "4", "5", _FIGURE)
_SCENE, _FRAME = "room", 0  # the paper's Fig. 6 shows frame 0
_ALL = "all"


def add_parser(benchmarks: Any) -> argparse.ArgumentParser:
    """Add the benchmark to the subparsers `benchmarks`."""
    parser: argparse.ArgumentParser = benchmarks.add_parser(
        "paper",
        help="the paper's tables, beside ours",
        description="Run the paper's recordings that lie below --data, and print its Tables 1 to 5 with a column of "
        "what was reached here; and Fig. 6, on a built-in scene. Replica and TUM RGB-D sequences are told by their "
        "folders' names and layouts. Tables go to stdout and, as Markdown and JSON, into --output. Runs that are "
        "finished there with the same settings are not done again.",
    )
    parser.add_argument(
        "tables", nargs="*", type=_table, default=[_ALL], metavar="TABLE",
        help=f"{', '.join(_NAMES)} or all (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--data", type=Path, required=True, metavar="DIR", help="folder with sequences, up to five folders down"
    )
    add_settings_options(parser)
    parser.add_argument(
        "--seeds", type=natural, nargs="+", default=[0], metavar="N", help="a run with each (default: 0)"
    )
    parser.add_argument(
        "--output", type=Path, default=Path("runs/paper"), metavar="DIR", help="folder (default: runs/paper)"
    )
    add_run_options(parser)
    parser.add_argument("--size", type=size, default=(640, 480), metavar="WxH", help="of Fig. 6 (default: 640x480)")
    parser.set_defaults(measure=_measure)
    return parser


def _measure(args: argparse.Namespace) -> dict[str, Any]:
    """All that was asked for; whatever is wrong with the arguments is said before anything runs."""
    from tgslam.bench import report

    names = _NAMES if _ALL in args.tables else args.tables
    tables = [table for table in paper_figures().tables if table.number in names]
    jobs, marks = _plan(args, tables)
    args.output.mkdir(parents=True, exist_ok=True)
    frame = measure_identity(args, _SCENE, _FRAME, args.size) if _FIGURE in names else None
    wanted, failures = each_once(job for row in jobs.values() for job in row), dict[Path, str]()
    try:
        carry_out(args, wanted, failures)
    finally:  # after Ctrl-C too
        found = {job.folder: metrics for job in wanted if (metrics := job.metrics()) is not None}
        result = {
            "benchmark": "paper",
            "machine": report.machine(),
            "source": paper_figures().source,
            "identity": frame,
            "tables": side_by_side.tabulate(tables, jobs, marks, found, failures),
            "runs": len(wanted),
            "failed": len(failures),
        }
        _write(args.output, result)
    return result


def _plan(args: argparse.Namespace, tables: Sequence[PaperTable]) -> tuple[dict[Row, list[Job]], dict[str, str]]:
    """The runs of each row whose sequence is there, and what is to be said of sequences, by their names.

    Raises ConfigError and DatasetError for settings and inputs that are wrong.
    """
    frames, overrides = parse_frames(args.frames), tuple(args.set)
    if "seed" in keys_of(overrides):
        raise ConfigError("--set seed: name it with --seeds")
    rows = list(dict.fromkeys(row for table in tables for row in table.rows))
    folders = find_sequences(args.data, dict.fromkeys(row.sequence for row in rows))
    if tables and not folders:
        raise DatasetError(
            f"{args.data}: no sequence of these tables is at or below it; they are told by their folders' names, such "
            "as room0 (Replica) or rgbd_dataset_freiburg1_desk (TUM RGB-D), and by their layouts (docs/measuring.md)"
        )
    _require_effect(overrides, [table for table in tables if any(row.sequence in folders for row in table.rows)])
    inputs = {sequence: folder_input(folder, args.config, overrides, frames) for sequence, folder in folders.items()}
    marks = {sequence.name: shortness(sequence, _length_s(input_, frames)) for sequence, input_ in inputs.items()}
    seeds, parent = list(dict.fromkeys(args.seeds)), args.output.resolve() / "runs"
    jobs = {
        row: [_job(row, inputs[row.sequence], seed, frames, parent) for seed in seeds]
        for row in rows
        if row.sequence in inputs
    }
    return jobs, marks


def _require_effect(overrides: tuple[str, ...], tables: Sequence[PaperTable]) -> None:
    """Raise ConfigError for an override of the user that a row of these tables would override itself."""
    for table in tables:
        for key in sorted(keys_of(overrides)):
            if any(key in keys_of(row.overrides) for row in table.rows):
                raise ConfigError(f"--set {key}: Table {table.number} sets it itself; leave one of the two out")


def _job(row: Row, input_: Input, seed: int, frames: Frames, parent: Path) -> Job:
    config = override(input_.config, (*row.overrides, f"seed={seed}"))
    return job_of(f"{row.name}, seed {seed}", input_, config, frames, parent)


def _length_s(input_: Input, frames: Frames) -> float:
    """Of what is run of a recording."""
    times_s = open_stored(input_.config.dataset, input_.folder).frames.times_s[slice(*frames)]
    return times_s[-1] - times_s[0] if times_s else 0.0


def _write(output: Path, result: dict[str, Any]) -> None:
    write_text(output / "paper.md", side_by_side.markdown(result["tables"], result["identity"], result["source"]))
    write_text(output / "paper.json", json.dumps(result, indent=2, allow_nan=False) + "\n")


def _table(text: str) -> str:
    if text not in (*_NAMES, _ALL):
        raise argparse.ArgumentTypeError(f"there is no table {text!r}; choose from {', '.join(_NAMES)} and all")
    return text
