"""The tables of the studies: mean and spread over the seeds, and the difference to the first variant."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from tgslam.bench.ablation.cases import Case
from tgslam.bench.runs.outcome import Failures, Metrics, markdown_grid, mean_text, outcome, over_seeds


def tabulate(cases: Sequence[Case], metrics: Metrics, failures: Failures) -> list[dict[str, Any]]:
    """A table for each study and input, as plain values.

    Columns without any value are left out: a recording has no known planes, say.
    """
    tables = []
    for _, group in groupby(cases, key=lambda case: (case.study.name, case.input)):
        rows = list(group)
        study, input_ = rows[0].study, rows[0].input
        columns = [
            column for column in study.columns
            if any(metrics.get(case.job.folder, {}).get(column.key) is not None for case in rows)
        ]  # fmt: skip
        tables.append(
            {
                "study": study.name,
                "title": study.title,
                "input": input_.name if input_.folder is None else str(input_.folder),
                "columns": [vars(column) for column in columns],
                "variants": _variants(rows, [column.key for column in columns], metrics, failures),
            }
        )
    return tables


def heading(table: dict[str, Any]) -> str:
    """What a table shows, on what."""
    return f"{table['title']}, {Path(table['input']).name}"


def header(table: dict[str, Any]) -> list[str]:
    """The titles of its columns."""
    return [table["study"], *(column["title"] for column in table["columns"]), "runs"]


def rows(table: dict[str, Any]) -> list[list[str]]:
    """Its cells: mean, spread where there are several seeds, and the difference to the first variant in brackets."""
    return [
        [variant["name"], *(_cell(variant["metrics"][c["key"]], c["digits"]) for c in table["columns"]), _runs(variant)]
        for variant in table["variants"]
    ]


def failed_runs(table: dict[str, Any]) -> list[str]:
    """A line for each run that failed."""
    return [
        f"{variant['name']}, seed {run['seed']}: {run['message']}"
        for variant in table["variants"]
        for run in variant["runs"]
        if run["message"] is not None
    ]


def markdown(tables: Sequence[dict[str, Any]]) -> str:
    """All of them as one page."""
    parts = ["Mean over the seeds, ± their standard deviation, and in brackets the difference to the first row."]
    for table in tables:
        parts += [f"## {heading(table)}", markdown_grid(header(table), rows(table))]
        failures = failed_runs(table)
        if failures:
            parts.append("\n".join(f"- failed: {failure}" for failure in failures))
    return "\n\n".join(parts) + "\n"


def identity_heading(result: dict[str, Any]) -> str:
    """What the study `identity` found, on what."""
    return (
        f"pixels whose plane is read wrongly, frame {result['frame']} of {result['scene']} {result['width']}x"
        f"{result['height']} with {result['planes']} planes, {result['gaussians']:,} Gaussians"
    )


def identity_rows(result: dict[str, Any]) -> list[list[str]]:
    """The titles of its table, and the rows."""
    curves = result["curves"]
    return [
        ["iterations", *(f"{identity} ids" for identity in curves)],
        *(
            [str(iteration), *(f"{curve['wrong'][number]:.2%}" for curve in curves.values())]
            for number, iteration in enumerate(result["iterations"])
        ),
    ]


def identity_markdown(result: dict[str, Any]) -> str:
    """Its table as a page."""
    titles, *body = identity_rows(result)
    return f"## {identity_heading(result)}\n\n{markdown_grid(titles, body)}\n"


def _variants(cases: list[Case], keys: list[str], metrics: Metrics, failures: Failures) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for name, group in groupby(cases, key=lambda case: case.variant.name):
        seeds = list(group)
        reference = found[0]["metrics"] if found else None
        values = {key: over_seeds([metrics.get(case.job.folder, {}).get(key) for case in seeds]) for key in keys}
        found.append(
            {
                "name": name,
                "overrides": list(seeds[0].study.overrides(seeds[0].variant)),
                "runs": [outcome(case.job, metrics, failures) for case in seeds],
                "metrics": {
                    key: {**value, "difference": _difference(value, reference and reference[key])}
                    for key, value in values.items()
                },
            }
        )
    return found


def _difference(value: dict[str, Any], reference: dict[str, Any] | None) -> float | None:
    if reference is None or value["mean"] is None or reference["mean"] is None:
        return None
    return float(value["mean"] - reference["mean"])


def _cell(value: dict[str, Any], digits: int) -> str:
    shift = value["difference"]
    difference = "" if shift is None else f" ({round(shift, digits) + 0.0:+.{digits}f})"  # never -0.00
    return f"{mean_text(value, digits)}{difference}"


def _runs(variant: dict[str, Any]) -> str:
    """How many of its runs are finished."""
    finished, asked = sum(run["state"] == "finished" for run in variant["runs"]), len(variant["runs"])
    return str(asked) if finished == asked else f"{finished} of {asked}"
