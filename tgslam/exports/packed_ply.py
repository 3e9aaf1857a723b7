"""SuperSplat's compressed PLY: 16 bytes a Gaussian, in chunks of 256 that each have a box of their own.

A chunk has the least and the largest position, logarithm of scale and colour in it. A vertex has, in 32 bits each:
position (11, 10 and 11 bits of the way through the box), rotation (which of w, x, y, z is largest, then the other three
in 10 bits each), scale (as the position) and colour with opacity (8 bits each).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.exports.quantised import as_units, opacity_of, unit_quat
from tgslam.files.atomic import atomic_file
from tgslam.types import Gaussians

Array = NDArray[np.float64]

CHUNK = 256
_AXES = ("x", "y", "z")
_CHUNK_PROPERTIES = (
    *(f"{end}_{axis}" for end in ("min", "max") for axis in _AXES),
    *(f"{end}_scale_{axis}" for end in ("min", "max") for axis in _AXES),
    *(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"),
)
_VERTEX_PROPERTIES = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_LEAST_LOG_SCALE, _MOST_LOG_SCALE = -20.0, 20.0
_MORTON_BITS = 10


def write_packed_ply(path: Path, gaussians: Gaussians) -> None:
    """Write the map, Gaussians that are near to each other in the same chunk. Raises OSError."""
    order = morton_order(gaussians.mean.astype(np.float64))
    position = gaussians.mean[order].astype(np.float64)
    log_scale = np.clip(gaussians.log_scale[order].astype(np.float64), _LEAST_LOG_SCALE, _MOST_LOG_SCALE)
    colour = gaussians.colour[order].astype(np.float64)
    boxes = [_boxes(values) for values in (position, log_scale, colour)]
    ways = [_way_through(values, box) for values, box in zip((position, log_scale, colour), boxes, strict=True)]
    rgba = as_units(np.column_stack([ways[2], opacity_of(gaussians)[order]]), 8)
    vertices = np.column_stack(
        [
            _pack_11_10_11(ways[0]),
            _pack_rotation(unit_quat(gaussians)[order]),
            _pack_11_10_11(ways[1]),
            rgba[:, 0] << 24 | rgba[:, 1] << 16 | rgba[:, 2] << 8 | rgba[:, 3],
        ]
    )
    with atomic_file(path) as file:
        file.write(_header(len(boxes[0]), len(gaussians)))
        file.write(np.concatenate(boxes, axis=1).astype("<f4").tobytes())
        file.write(vertices.astype("<u4").tobytes())


def morton_order(points: Array) -> NDArray[np.int64]:
    """The order of points [N, 3] along a curve that keeps neighbours together."""
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = points.min(axis=0), points.max(axis=0)
    cells = as_units((points - low) / np.maximum(high - low, np.finfo(np.float64).tiny), _MORTON_BITS)
    code = np.zeros(len(points), np.uint32)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << np.uint32(3 * bit + axis)
    return np.argsort(code, kind="stable")


def _header(chunks: int, vertices: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in _CHUNK_PROPERTIES]
    lines += [f"element vertex {vertices}"]
    lines += [f"property uint {name}" for name in _VERTEX_PROPERTIES]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def _boxes(values: Array) -> Array:
    """[chunks, 6] least and largest of values [N, 3], as float32 holds them."""
    starts = np.arange(0, len(values), CHUNK)
    if not len(starts):
        return np.zeros((0, 6))
    box = np.concatenate([np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)], axis=1)
    return box.astype(np.float32).astype(np.float64)


def _way_through(values: Array, boxes: Array) -> Array:
    """[N, 3] in [0, 1]: where values [N, 3] lie in the boxes of their chunks."""
    box = boxes[np.arange(len(values)) // CHUNK]
    return (values - box[:, :3]) / np.maximum(box[:, 3:] - box[:, :3], np.finfo(np.float32).tiny)


def _pack_11_10_11(values: Array) -> NDArray[np.uint32]:
    x, y, z = as_units(values[:, 0], 11), as_units(values[:, 1], 10), as_units(values[:, 2], 11)
    return np.asarray(x << 21 | y << 11 | z, np.uint32)


def _pack_rotation(quat: Array) -> NDArray[np.uint32]:
    """Unit quaternions [N, 4] wxyz; the largest component is left out, and is positive."""
    rows = np.arange(len(quat))
    largest = np.argmax(np.abs(quat), axis=1)
    quat = quat * np.where(quat[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    parts = as_units(np.take_along_axis(quat, others, axis=1) * np.sqrt(0.5) + 0.5, 10)
    bits = largest.astype(np.uint32) << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
    return np.asarray(bits, np.uint32)
