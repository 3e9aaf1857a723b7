"""log.jsonl: one line of JSON a frame, flushed at once, so that a run that is cut off still says how far it came."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from types import TracebackType
from typing import Any

from tgslam.errors import OutputError
from tgslam.types import FrameReport, FrameStatus


class FrameLog:
    """The log of a run that is going on; use it in a `with` block."""

    def __init__(self, path: Path) -> None:
        """Start an empty log at `path`. Raises OSError."""
        self._file = path.open("w", encoding="utf-8", newline="\n")

    def append(self, report: FrameReport) -> None:
        """Write one line and hand it to the system. Raises OSError, for example when the disk is full."""
        self._file.write(to_json(report) + "\n")
        self._file.flush()

    def __enter__(self) -> FrameLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def to_json(report: FrameReport) -> str:
    """A frame report as one line of JSON; what is not finite becomes null."""
    fields = {name: value for name, value in vars(report).items() if name != "T_wc"}  # the trajectory has the poses
    return json.dumps(plain({**fields, "status": report.status.value}), allow_nan=False)


def read_log(path: Path) -> list[FrameReport]:
    """The reports of a log in the order of the frames.

    A last line without its end, as a killed run leaves it, is left out. Raises OutputError for anything else that is
    not a frame report.
    """
    try:
        lines = path.read_text(encoding="utf-8").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise OutputError(f"{path}: cannot be read: {error}") from error
    return [_report(path, number, line) for number, line in enumerate(lines[:-1], start=1)]


def plain(value: Any) -> Any:
    """`value` in JSON's types: NumPy scalars as numbers, NaN and infinity as null."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _report(path: Path, number: int, line: str) -> FrameReport:
    try:
        values = json.loads(line)
        known = {field.name: values[field.name] for field in dataclasses.fields(FrameReport) if field.name in values}
        known["status"] = FrameStatus(known["status"])
        known["timestamp_s"] = math.nan if known["timestamp_s"] is None else float(known["timestamp_s"])
        return FrameReport(**known)
    except (ValueError, KeyError, TypeError) as error:
        raise OutputError(f"{path}:{number}: damaged: not a frame report") from error
