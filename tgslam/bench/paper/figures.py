"""The paper's tables as data: figures.yaml, which says where they are from, and what their rows ask for."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tgslam.bench.ablation.studies import STUDIES, Column
from tgslam.config.yaml_text import parse_yaml

_FILE = Path(__file__).with_suffix(".yaml")
_COLUMNS = {
    column.key: column
    for column in (
        Column("ate_rmse_cm", "ATE, cm", 2),
        Column("psnr_db", "PSNR, dB", 2),
        Column("ssim", "SSIM", 3),
        Column("lpips", "LPIPS", 3),
        Column("depth_l1_cm", "depth L1, cm", 2),
    )
}


@dataclass(frozen=True)
class Sequence:
    """A recording of the paper."""

    name: str
    layout: str  # as `dataset.format` calls it
    folder: str  # regular expression of the end of its folder's name, in lower case
    seconds: float  # its published length, roughly


@dataclass(frozen=True)
class Row:
    """One row of a table: a sequence, run with these overrides."""

    name: str
    sequence: Sequence
    overrides: tuple[str, ...]


@dataclass(frozen=True)
class Measure:
    """One metric of a table, and what the paper prints of it."""

    column: Column
    printed: Mapping[str, tuple[float | None, ...]]  # by method, in the order of the rows; last, the average if any


@dataclass(frozen=True)
class PaperTable:
    """One table of the paper."""

    number: str
    title: str
    rows: tuple[Row, ...]
    has_average: bool
    measures: tuple[Measure, ...]


@dataclass(frozen=True)
class Figures:
    """All of them."""

    source: str
    sequences: tuple[Sequence, ...]
    tables: tuple[PaperTable, ...]


@functools.cache
def paper_figures() -> Figures:
    """What figures.yaml says."""
    content = parse_yaml(_FILE.read_text(encoding="utf-8"))
    sequences = {name: Sequence(name, **facts) for name, facts in content["sequences"].items()}
    tables = tuple(_table(entry, sequences) for entry in content["tables"])
    return Figures(content["source"], tuple(sequences.values()), tables)


def _table(entry: Mapping[str, Any], sequences: Mapping[str, Sequence]) -> PaperTable:
    measures = (
        Measure(_COLUMNS[key], {method: tuple(values) for method, values in printed.items()})
        for key, printed in entry["figures"].items()
    )
    study, variants = entry.get("study"), entry.get("variants", ())
    rows = [row for name in entry["rows"] for row in _rows(sequences[name], study, variants)]
    return PaperTable(entry["number"], entry["title"], tuple(rows), entry["average"], tuple(measures))


def _rows(sequence: Sequence, study: str | None, names: list[str]) -> list[Row]:
    """Those of one sequence: one, or one for each of these variants of the study."""
    if study is None:
        return [Row(sequence.name, sequence, ())]
    found = STUDIES[study]
    variants = {variant.name: variant for variant in found.variants}
    return [Row(f"{sequence.name}, {name}", sequence, found.overrides(variants[name])) for name in names]
