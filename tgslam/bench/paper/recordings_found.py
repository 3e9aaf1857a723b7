"""Which of the paper's sequences lie below a folder, told by the names of folders and by what is in them."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Collection, Iterator
from pathlib import Path

from tgslam.bench.paper.figures import Sequence
from tgslam.datasets.formats import layout_of
from tgslam.errors import DatasetError

_MOST_LEVELS = 5  # of folders; the benchmarks' archives have two
_WHOLE = 0.8  # of the published length, which counts from before the first image until after the last
_log = logging.getLogger(__name__)


def find_sequences(data: Path, sequences: Collection[Sequence]) -> dict[Sequence, Path]:
    """Their folders, at or below `data`. A sequence that is there twice counts once, which is said.

    Raises DatasetError when `data` is no folder.
    """
    if not data.is_dir():
        raise DatasetError(f"{data}: {'not a folder' if data.exists() else 'no such folder'}; check --data")
    patterns = [(re.compile(rf"(?:.*[^a-z0-9])?(?:{sequence.folder})"), sequence) for sequence in sequences]
    found: dict[Sequence, Path] = {}
    for folder in _folders(data):
        name = folder.resolve().name if folder == data else folder.name
        plain = name.lower().replace("-", "_").replace(" ", "_")
        sequence = next((sequence for pattern, sequence in patterns if pattern.fullmatch(plain)), None)
        if sequence is None or not _has_layout(folder, sequence.layout):
            continue
        if sequence in found:
            _log.warning("%s: %s is there already, at %s, which counts", folder, sequence.name, found[sequence])
        found.setdefault(sequence, folder)
    return found


def shortness(sequence: Sequence, length_s: float) -> str:
    """A mark for a recording that is only a part of the sequence; "" for a whole one. length_s: of what is run."""
    if length_s >= _WHOLE * sequence.seconds:
        return ""
    return f"only {length_s:.1f} s of about {sequence.seconds:.0f}"


def _has_layout(folder: Path, name: str) -> bool:
    try:
        layout = layout_of(folder)
    except OSError as cause:
        _log.warning("%s: left out, as it cannot be read (%s)", folder, cause.strerror)
        return False
    return layout is not None and layout.name == name


def _folders(top: Path) -> Iterator[Path]:
    """`top` and what is below it, each real folder once, in the order of names; links are followed."""
    seen = set[str]()
    for path, names, _ in os.walk(top, followlinks=True):
        folder = Path(path)
        names[:] = sorted(name for name in names if not name.startswith("."))
        if len(folder.relative_to(top).parts) >= _MOST_LEVELS:
            names.clear()
        real = os.path.realpath(path)
        if real in seen:
            names.clear()
            continue
        seen.add(real)
        yield folder
