"""What became of runs, as plain values and as the cells of a table."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tgslam.bench.runs.jobs import Job

Metrics = Mapping[Path, dict[str, Any]]  # of the runs that came to their end, by their folders
Failures = Mapping[Path, str]  # why the others did not

NO_VALUE = "-"


def outcome(job: Job, metrics: Metrics, failures: Failures) -> dict[str, Any]:
    """Where the run is, whether it is finished, failed or missing, and why it failed."""
    folder = job.folder
    state = "finished" if folder in metrics else "failed" if folder in failures else "missing"
    return {"seed": job.config.seed, "folder": str(folder), "state": state, "message": failures.get(folder)}


def over_seeds(values: list[float | None]) -> dict[str, Any]:
    """Mean and spread. values: by seed; null where a run failed or the metric does not apply."""
    known = [value for value in values if value is not None]
    return {
        "values": values,
        "mean": statistics.fmean(known) if known else None,
        "spread": statistics.stdev(known) if len(known) > 1 else None,
    }


def mean_text(value: dict[str, Any], digits: int) -> str:
    """The mean of `over_seeds`, with its spread where there are several seeds."""
    if value["mean"] is None:
        return NO_VALUE
    spread = "" if value["spread"] is None else f" ± {value['spread']:.{digits}f}"
    return f"{value['mean']:.{digits}f}{spread}"


def markdown_grid(titles: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, numbers to the right."""
    lines = [titles, ["---", *["---:"] * (len(titles) - 1)], *body]
    return "\n".join(f"| {' | '.join(map(_escaped, cells))} |" for cells in lines)


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|")
