"""Which colour image goes with which depth image: the benchmark's list files and association files."""

from __future__ import annotations

import logging
import math
import re
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar

from tgslam.datasets.named_files import named_file
from tgslam.datasets.time_matching import associate_times, seconds_in
from tgslam.errors import DatasetError
from tgslam.files.tum_text import Row, read_rows

_log = logging.getLogger(__name__)

ASSOCIATION_FILES = ("associations.txt", "associate.txt", "association.txt")
_NUMBER = r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?"
_ASSOCIATION = re.compile(rf"({_NUMBER})[\s,]+(.+?)[\s,]+({_NUMBER})[\s,]+(.+)")  # names may hold blanks


class ImagePair(NamedTuple):
    """The files of one frame, at the time of its colour image."""

    timestamp_s: float
    colour: Path
    depth: Path


class _Image(NamedTuple):
    timestamp_s: float
    path: Path


_Stamped = TypeVar("_Stamped", ImagePair, _Image)


def find_association_file(folder: Path) -> Path | None:
    """The association file of a sequence folder, if it has one."""
    return next((folder / name for name in ASSOCIATION_FILES if (folder / name).is_file()), None)


def has_image_numbers(associations: Path) -> bool:
    """Whether the first row of an association file has a whole number in place of a time, as ICL-NUIM's do."""
    with associations.open(encoding="utf-8-sig", errors="replace") as file:
        first = next((line for line in file if line.strip() and not line.startswith("#")), "")
    return first.replace(",", " ").split()[:1] != [] and first.replace(",", " ").split()[0].isdecimal()


def pairs_from_lists(colour_list: Path, depth_list: Path, tolerance_s: float) -> list[ImagePair]:
    """Pair the rows `timestamp file` of two lists by time, as the benchmark's own tool does.

    Raises DatasetError for a list that is empty or malformed (file and line), and when nothing pairs.
    """
    colour, depth = _read_list(colour_list), _read_list(depth_list)
    colour_index, depth_index = associate_times(
        [image.timestamp_s for image in colour], [image.timestamp_s for image in depth], tolerance_s
    )
    if not len(colour_index):
        raise DatasetError(
            f"{depth_list}: no depth image is within {tolerance_s:g} s of a colour image; "
            "check the timestamps, or raise dataset.expert.depth_tolerance_s"
        )
    if 2 * len(colour_index) < len(colour):
        _log.warning("%s: only %d of %d colour images have a depth image", colour_list, len(colour_index), len(colour))
    return [
        ImagePair(colour[i].timestamp_s, colour[i].path, depth[j].path)
        for i, j in zip(colour_index, depth_index, strict=True)
    ]


def pairs_from_associations(path: Path) -> list[ImagePair]:
    """Rows `time file time file`; which file is depth is told by its name, and is the same in all rows.

    Raises DatasetError for an empty file and a malformed row (file and line).
    """
    pairs = []
    for row in read_rows(path, DatasetError):
        where, fields = f"{path}:{row.line}", _association_fields(row)
        if len(fields) != 4:
            raise DatasetError(f"{where}: expected 'time colour-file time depth-file', found {len(fields)} fields")
        depth_first = _is_depth(fields[1])
        if depth_first == _is_depth(fields[3]):
            raise DatasetError(
                f"{where}: cannot tell colour from depth; exactly one of the two file names must contain 'depth'"
            )
        colour_at, depth_at = (2, 0) if depth_first else (0, 2)
        _timestamp(fields[depth_at], where)
        pairs.append(
            ImagePair(
                _timestamp(fields[colour_at], where),
                named_file(path.parent, fields[colour_at + 1], where),
                named_file(path.parent, fields[depth_at + 1], where),
            )
        )
    return _by_time(pairs, path)


def _is_depth(name: str) -> bool:
    return "depth" in name.lower()


def _read_list(path: Path) -> list[_Image]:
    images = []
    for row in read_rows(path, DatasetError):
        where, fields = f"{path}:{row.line}", row.fields
        file = None
        if len(fields) == 2:
            file = named_file(path.parent, fields[1], where)
        elif len(fields) > 2:  # the name holds blanks or commas; if there is no such file, the row is none
            file = named_file(path.parent, row.text[len(fields[0]) :].lstrip(", \t"), where)
        if file is None or (len(fields) > 2 and not file.exists()):
            raise DatasetError(f"{where}: expected 'timestamp file', found {row.text[:60]!r}")
        images.append(_Image(_timestamp(fields[0], where), file))
    return _by_time(images, path)


def _association_fields(row: Row) -> list[str]:
    """time, name, time, name; names may hold blanks or commas."""
    found = _ASSOCIATION.fullmatch(row.text) if len(row.fields) > 4 else None
    return list(found.groups()) if found else row.fields


def _timestamp(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DatasetError(f"{where}: {text!r} is not a timestamp in seconds")
    return value


def _by_time(rows: list[_Stamped], path: Path) -> list[_Stamped]:
    """Rows at increasing times; of those at the same time the first listed stays. Raises DatasetError without rows."""
    if not rows:
        raise DatasetError(f"{path}: lists no image; the file is empty or holds comments only")
    seconds = seconds_in([row.timestamp_s for row in rows], str(path))
    if seconds != 1.0:
        rows = [row._replace(timestamp_s=row.timestamp_s * seconds) for row in rows]
    ordered = sorted(rows, key=lambda row: row.timestamp_s)
    if ordered != rows:
        _log.warning("%s: its rows are not in order of time; sorted them", path)
    kept = ordered[:1] + [row for before, row in pairwise(ordered) if row[0] > before[0]]
    if len(kept) < len(rows):
        _log.warning("%s: dropped %d rows whose timestamp had come before", path, len(rows) - len(kept))
    return kept
