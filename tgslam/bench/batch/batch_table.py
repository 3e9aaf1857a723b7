"""The one table of a batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tgslam.bench.ablation.studies import Column
from tgslam.bench.runs.jobs import Job
from tgslam.bench.runs.outcome import NO_VALUE, Failures, Metrics, markdown_grid, outcome

_COLUMNS = (
    Column("frames", "frames", 0),
    Column("tracked_fraction", "tracked", 3),
    Column("ate_rmse_cm", "ATE, cm", 2),
    Column("ate_rmse_all_cm", "ATE, all frames, cm", 2),
    Column("psnr_db", "PSNR, dB", 2),
    Column("ssim", "SSIM", 4),
    Column("lpips", "LPIPS", 3),
    Column("depth_l1_cm", "depth L1, cm", 2),
    Column("gaussians", "Gaussians", 0),
    Column("closures", "closures", 0),
    Column("fps", "frames/s", 2),
    Column("wall_s", "time, s", 0),
)


def tabulate(names: Sequence[str], jobs: Sequence[Job], metrics: Metrics, failures: Failures) -> dict[str, Any]:
    """A row a recording, as plain values. Columns without any value are left out."""
    columns = [
        column for column in _COLUMNS
        if any(metrics.get(job.folder, {}).get(column.key) is not None for job in jobs)
    ]  # fmt: skip
    rows = [
        {
            "name": name,
            "input": str(job.input),
            **outcome(job, metrics, failures),
            "metrics": {column.key: metrics.get(job.folder, {}).get(column.key) for column in columns},
        }
        for name, job in zip(names, jobs, strict=True)
    ]
    return {"columns": [vars(column) for column in columns], "rows": rows}


def header(table: dict[str, Any]) -> list[str]:
    """The titles of its columns."""
    return ["recording", *(column["title"] for column in table["columns"]), "run"]


def rows(table: dict[str, Any]) -> list[list[str]]:
    """Its cells."""
    return [
        [row["name"], *(_cell(row["metrics"][c["key"]], c["digits"]) for c in table["columns"]), row["state"]]
        for row in table["rows"]
    ]


def failed_runs(table: dict[str, Any]) -> list[str]:
    """A line for each run that failed."""
    return [f"{row['name']}: {row['message']}" for row in table["rows"] if row["message"] is not None]


def markdown(table: dict[str, Any]) -> str:
    """It as a page."""
    parts = [markdown_grid(header(table), rows(table))]
    failures = failed_runs(table)
    if failures:
        parts.append("\n".join(f"- failed: {failure}" for failure in failures))
    return "\n\n".join(parts) + "\n"


def _cell(value: float | None, digits: int) -> str:
    return NO_VALUE if value is None else f"{value:.{digits}f}"
