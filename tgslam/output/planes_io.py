"""planes.json: the persistent planes of a run as plain numbers, in the world frame of map.ply."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.errors import OutputError
from tgslam.files.atomic import write_text
from tgslam.types import Plane

_UNIT_TOLERANCE = 1e-6  # of a normal's length
_ON_PLANE_M = 1e-3  # that a centroid may be off its plane


def write_planes(path: Path, planes: Sequence[Plane]) -> None:
    """Write the planes; the same planes give the same bytes.

    Raises OutputError for values that are not finite, and OSError when the file cannot be written.
    """
    try:
        lines = [json.dumps(_object(plane), allow_nan=False) for plane in planes]
    except ValueError as error:
        raise OutputError(f"{path}: not written: a plane holds values that are not finite") from error
    write_text(path, '{"planes": [\n' + ",\n".join(lines) + "\n]}\n")


def read_planes(path: Path) -> tuple[Plane, ...]:
    """Read the planes of a run. Raises OutputError for anything else than a whole file of `write_planes`."""
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))["planes"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise OutputError(f"{path}: cannot be read: {error}") from error
    if not isinstance(entries, list):
        raise OutputError(f"{path}: damaged: `planes` is not a list")
    planes = tuple(_plane(path, number, entry) for number, entry in enumerate(entries))
    if len({plane.id for plane in planes}) != len(planes):
        raise OutputError(f"{path}: damaged: two planes have the same id")
    return planes


def _object(plane: Plane) -> dict[str, Any]:
    return {
        "id": plane.id,
        "equation": [*plane.normal_w.tolist(), plane.offset_m],
        "centroid": plane.centroid_w.tolist(),
        "covariance": plane.covariance.tolist(),
        "colour": list(plane.colour),
        "area_m2": plane.area_m2,
        "inlier_rms_mm": 1000.0 * plane.inlier_rms_m,
        "keyframes": list(plane.keyframes),
        "polygons": [polygon.tolist() for polygon in plane.polygons_w],
    }


def _plane(path: Path, number: int, entry: Any) -> Plane:
    try:
        equation = _array(entry["equation"], (4,))
        red, green, blue = _array(entry["colour"], (3,)).tolist()
        plane = Plane(
            id=_whole(entry["id"]),
            normal_w=equation[:3],
            offset_m=float(equation[3]),
            centroid_w=_array(entry["centroid"], (3,)),
            covariance=_array(entry["covariance"], (3, 3)),
            colour=(red, green, blue),
            polygons_w=tuple(_array(polygon, (None, 3)) for polygon in entry["polygons"]),
            area_m2=_not_negative(entry["area_m2"]),
            inlier_rms_m=_not_negative(entry["inlier_rms_mm"]) / 1000.0,
            keyframes=tuple(_whole(keyframe) for keyframe in entry["keyframes"]),
        )
        _check(plane)
    except KeyError as error:
        raise OutputError(f"{path}: damaged: plane number {number} has no {error}") from error
    except (TypeError, ValueError) as error:
        raise OutputError(f"{path}: damaged: plane number {number}: {error}") from error
    return plane


def _check(plane: Plane) -> None:
    if abs(float(np.linalg.norm(plane.normal_w)) - 1.0) > _UNIT_TOLERANCE:
        raise ValueError("its normal is not of unit length")
    if abs(float(plane.normal_w @ plane.centroid_w) + plane.offset_m) > _ON_PLANE_M:
        raise ValueError("its centroid is not on it")
    if not all(0.0 <= value <= 1.0 for value in plane.colour):
        raise ValueError("its colour is not in [0, 1]")
    if any(len(polygon) < 3 for polygon in plane.polygons_w):
        raise ValueError("a polygon has fewer than 3 corners")


def _array(values: Any, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    """`values` as finite float64 of that shape, None for any length. Raises ValueError and TypeError."""
    array = np.array(values, np.float64)
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or not np.isfinite(array).all():
        raise ValueError(f"expected finite numbers of shape {shape}, not {str(values)[:60]}")
    return array


def _whole(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"expected a whole number of 0 or more, not {value!r}")
    return value


def _not_negative(value: Any) -> float:
    if type(value) not in (int, float) or not math.isfinite(value) or value < 0:
        raise ValueError(f"expected a number of 0 or more, not {value!r}")
    return float(value)
