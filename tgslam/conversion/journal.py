"""What a conversion has done so far, in the folder that it writes: an interrupted one goes on from there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from tgslam.conversion.targets import Written
from tgslam.errors import OutputError
from tgslam.files.atomic import write_text

_NAME = ".conversion.jsonl"


class Journal:
    """A line that says what is converted, and a line a frame: `null` for one that is left out."""

    def __init__(self, path: Path, done: list[Written | None]) -> None:
        self.done, self._path = done, path
        self.next_number = sum(frame is not None for frame in done)

    @classmethod
    def open(cls, folder: Path, what: dict[str, Any]) -> Journal:
        """Begin in a new or empty folder, or go on in one that a conversion of the same left unfinished.

        what: plain values that tell this conversion from others. Raises OutputError for any other folder, and OSError.
        """
        path = folder / _NAME
        if path.is_file():
            return cls(path, _read(path, folder, what))
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"{folder} exists and is not an empty folder; name another, or remove it first")
        folder.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps(what) + "\n")
        return cls(path, [])

    def add(self, frame: Written | None) -> None:
        """The next frame is done."""
        self.done.append(frame)
        self.next_number += frame is not None
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(_plain(frame)) + "\n")

    def close(self) -> None:
        """Everything is there."""
        self._path.unlink()


def _read(path: Path, folder: Path, what: dict[str, Any]) -> list[Written | None]:
    """The frames that are done; a last line that was cut off does not count, and goes."""
    head, *lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    if not head.endswith("\n") or json.loads(head) != json.loads(json.dumps(what)):
        raise OutputError(
            f"{folder} holds an unfinished conversion of something else, or to another layout; name another folder, "
            "or remove it first"
        )
    if lines and not lines[-1].endswith("\n"):
        lines.pop()
        write_text(path, "".join([head, *lines]))
    try:
        return [_frame(json.loads(line)) for line in lines]
    except (ValueError, TypeError, KeyError) as error:
        raise OutputError(f"{path}: damaged ({error}); remove {folder} and start again") from error


def _plain(frame: Written | None) -> dict[str, Any] | None:
    if frame is None:
        return None
    T_wc = None if frame.T_wc is None else frame.T_wc.tolist()
    return {"number": frame.number, "timestamp_s": frame.timestamp_s, "T_wc": T_wc}


def _frame(values: dict[str, Any] | None) -> Written | None:
    if values is None:
        return None
    T_wc = None if values["T_wc"] is None else np.array(values["T_wc"], np.float64).reshape(4, 4)
    return Written(int(values["number"]), float(values["timestamp_s"]), T_wc)
