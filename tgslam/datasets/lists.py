"""Which colour image goes with which depth image: the benchmark's list files and association files."""

from __future__ import annotations

import logging
import math
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar

from tgslam.datasets.time_matching import associate_times
from tgslam.errors import DatasetError
from tgslam.files.clock import ticks_per_second, unit_name
from tgslam.files.tum_text import read_rows

_log = logging.getLogger(__name__)

ASSOCIATION_FILES = ("associations.txt", "associate.txt", "association.txt")


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
            "check the timestamps, or raise dataset.depth_tolerance_s"
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
    for line, fields in read_rows(path, DatasetError):
        where = f"{path}:{line}"
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
                path.parent / fields[colour_at + 1],
                path.parent / fields[depth_at + 1],
            )
        )
    return in_seconds(_by_time(pairs, path), path)


def _is_depth(name: str) -> bool:
    return "depth" in name.lower()


def _read_list(path: Path) -> list[_Image]:
    images = []
    for line, fields in read_rows(path, DatasetError):
        if len(fields) != 2:
            raise DatasetError(f"{path}:{line}: expected 'timestamp file', found {' '.join(fields)[:60]!r}")
        images.append(_Image(_timestamp(fields[0], f"{path}:{line}"), path.parent / fields[1]))
    return in_seconds(_by_time(images, path), path)


def in_seconds(rows: list[_Stamped], path: Path) -> list[_Stamped]:
    """Rows at increasing times of a clock that may count in nanoseconds or such; it is then said."""
    ticks = ticks_per_second([row.timestamp_s for row in rows])
    if ticks == 1.0:
        return rows
    _log.warning("%s: its clock counts in %s; times are divided by %g", path, unit_name(ticks), ticks)
    return [row._replace(timestamp_s=row.timestamp_s / ticks) for row in rows]


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
    ordered = sorted(rows, key=lambda row: row.timestamp_s)
    if ordered != rows:
        _log.warning("%s: its rows are not in order of time; sorted them", path)
    kept = ordered[:1] + [row for before, row in pairwise(ordered) if row[0] > before[0]]
    if len(kept) < len(rows):
        _log.warning("%s: dropped %d rows whose timestamp had come before", path, len(rows) - len(kept))
    return kept
