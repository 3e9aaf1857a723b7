"""The paper's tables with a column for what was reached here; holes are marked."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from tgslam.bench.ablation.results import identity_heading, identity_rows
from tgslam.bench.paper.figures import Measure, PaperTable, Row
from tgslam.bench.runs.jobs import Job
from tgslam.bench.runs.outcome import NO_VALUE, Failures, Metrics, markdown_grid, mean_text, outcome, over_seeds

HERE = "tgslam"
_AVERAGE = "Avg"
_NOT_FOUND, _NOT_MEASURED = "not found", "not measured"

Jobs = Mapping[Row, Sequence[Job]]  # by seed, of the rows whose sequences are there


def tabulate(
    tables: Sequence[PaperTable], jobs: Jobs, marks: Mapping[str, str], metrics: Metrics, failures: Failures
) -> list[dict[str, Any]]:
    """The tables as plain values. marks: what is to be said of the recording of a sequence, by its name."""
    return [_table(table, jobs, marks, metrics, failures) for table in tables]


def absent(tables: Sequence[dict[str, Any]]) -> list[str]:
    """A line for each table of which nothing is there: it is not shown."""
    return [
        f"Table {table['table']} ({table['title']}): none of its sequences was found"
        for table in tables
        if not table["runs"]
    ]


def shown(tables: Sequence[dict[str, Any]]) -> list[tuple[str, list[str], list[list[str]]]]:
    """(heading, titles of the columns, rows) of each metric of each table of which something is there."""
    return [
        (
            f"Table {table['table']}: {table['title']}, {measure['title']}",
            ["sequence", *measure["methods"], HERE, "note"],
            [_cells(row, measure) for row in measure["rows"]],
        )
        for table in tables
        if table["runs"]
        for measure in table["measures"]
    ]


def failed_runs(tables: Sequence[dict[str, Any]]) -> list[str]:
    """A line for each run that failed."""
    lines = (
        f"{name}, seed {run['seed']}: {run['message']}"
        for table in tables
        for name, runs in table["runs"].items()
        for run in runs
        if run["message"] is not None
    )
    return list(dict.fromkeys(lines))


def markdown(tables: Sequence[dict[str, Any]], frame: dict[str, Any] | None, source: str) -> str:
    """All of them as one page. frame: what `bench ablation identity` finds."""
    parts = [
        f"Figures from: {source}. The column `{HERE}` is measured here; {NO_VALUE} is a hole. The paper does not say "
        "which frames its images are compared at; here they are held out from mapping.",
    ]
    for heading, titles, rows in shown(tables):
        parts += [f"## {heading}", markdown_grid(titles, rows)]
    if frame is not None:
        parts += [f"## {figure_heading(frame)}", markdown_grid(*_split(identity_rows(frame)))]
    lines = [*absent(tables), *(f"failed: {failure}" for failure in failed_runs(tables))]
    if lines:
        parts.append("\n".join(f"- {line}" for line in lines))
    return "\n\n".join(parts) + "\n"


def figure_heading(frame: dict[str, Any]) -> str:
    """What stands above Fig. 6, of which the paper prints pictures and no figures."""
    return f"Fig. 6: {identity_heading(frame)}; the paper shows pictures only"


def _split(rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
    return rows[0], rows[1:]


def _table(
    table: PaperTable, jobs: Jobs, marks: Mapping[str, str], metrics: Metrics, failures: Failures
) -> dict[str, Any]:
    return {
        "table": table.number,
        "title": table.title,
        "measures": [_measure(table, measure, jobs, marks, metrics) for measure in table.measures],
        "runs": {row.name: [outcome(job, metrics, failures) for job in jobs[row]] for row in table.rows if row in jobs},
    }


def _measure(
    table: PaperTable, measure: Measure, jobs: Jobs, marks: Mapping[str, str], metrics: Metrics
) -> dict[str, Any]:
    key = measure.column.key
    here = [over_seeds([metrics.get(job.folder, {}).get(key) for job in jobs.get(row, ())]) for row in table.rows]
    names, holes = [row.name for row in table.rows], [value["mean"] is None for value in here]
    notes = [_note(row, jobs, marks, metrics, is_hole) for row, is_hole in zip(table.rows, holes, strict=True)]
    if table.has_average:
        means = [value["mean"] for value in here]
        known = [mean for mean in means if mean is not None]
        whole = len(known) == len(means)
        here.append(over_seeds([statistics.fmean(known)] if whole else []))
        names.append(_AVERAGE)
        notes.append(_average_note(len(known), len(means), any(notes)))
    rows = [
        {"name": name, "printed": {m: values[n] for m, values in measure.printed.items()}, "here": value, "note": note}
        for n, (name, value, note) in enumerate(zip(names, here, notes, strict=True))
    ]
    return {**vars(measure.column), "methods": list(measure.printed), "rows": rows}


def _note(row: Row, jobs: Jobs, marks: Mapping[str, str], metrics: Metrics, is_hole: bool) -> str:
    if row not in jobs:
        return _NOT_FOUND
    finished = sum(job.folder in metrics for job in jobs[row])
    runs = f"{finished} of {len(jobs[row])} runs" if finished < len(jobs[row]) else _NOT_MEASURED if is_hole else ""
    return "; ".join(filter(None, (marks.get(row.sequence.name, ""), runs)))


def _average_note(known: int, count: int, marked: bool) -> str:
    if known < count:
        return f"{known} of {count} sequences"
    return "see the notes above" if marked else ""


def _cells(row: dict[str, Any], measure: dict[str, Any]) -> list[str]:
    digits = measure["digits"]
    printed = (row["printed"][method] for method in measure["methods"])
    texts = [NO_VALUE if value is None else f"{value:.{digits}f}" for value in printed]
    return [row["name"], *texts, mean_text(row["here"], digits), row["note"]]
