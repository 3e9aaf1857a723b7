"""JSON that recordings bring: read with messages that name the file and the key."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.errors import DatasetError

_MOST_BYTES = 1 << 29
_LARGEST = 1e300  # whole numbers of JSON may be larger than any float


def read_object(path: Path) -> dict[str, Any]:
    """The JSON object that a file holds. Raises DatasetError."""
    try:
        if path.stat().st_size > _MOST_BYTES or not path.is_file():
            raise DatasetError(f"{path}: no file, or over {_MOST_BYTES >> 20} MiB; it should describe the recording")
        data = path.read_bytes()
    except OSError as cause:
        raise DatasetError(f"{path}: cannot be read ({cause.strerror})") from cause
    return parse_object(data, str(path))


def parse_object(data: bytes, name: str) -> dict[str, Any]:
    """The JSON object in some bytes. Raises DatasetError, which names `name`."""
    try:
        value = json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as cause:
        raise DatasetError(f"{name}: not JSON that can be read ({cause}); get the file again") from cause
    if not isinstance(value, dict):
        raise DatasetError(f"{name}: expected a JSON object, found a {type(value).__name__}")
    return value


def number(mapping: Mapping[str, Any], key: str, name: str, default: float | None = None) -> float:
    """A finite number of a JSON object. Raises DatasetError without one and a default."""
    value = mapping.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < _LARGEST:
        raise DatasetError(f"{name}: expected a number as {key!r}, found {_short(value)}")
    return float(value)


def numbers(mapping: Mapping[str, Any], key: str, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """An array of a JSON object; its count of numbers is that of `shape`, -1 = any. They need not be finite."""
    try:
        return np.asarray(mapping[key], np.float64).reshape(shape)
    except (KeyError, OverflowError, TypeError, ValueError) as cause:
        sizes = "x".join("N" if side < 0 else str(side) for side in shape)
        raise DatasetError(f"{name}: expected {sizes} numbers as {key!r}, found {_short(mapping.get(key))}") from cause


def _short(value: object) -> str:
    return "none" if value is None else repr(value)[:60]
