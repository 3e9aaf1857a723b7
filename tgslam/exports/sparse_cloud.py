"""Points with colours that stand for the map where a format has no Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.exports.quantised import as_bytes, opacity_of
from tgslam.files.atomic import atomic_file
from tgslam.types import Gaussians

MOST_POINTS = 100_000
_LEAST_OPACITY = 0.5
_ROW = np.dtype([("position", "<f4", 3), ("colour", "u1", 3)])
_HEADER = """ply
format binary_little_endian 1.0
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
"""


@dataclass(frozen=True)
class SparseCloud:
    """Points on surfaces."""

    points_w: NDArray[np.float64]  # [N, 3] m
    colours: NDArray[np.uint8]  # [N, 3] RGB


def sparse_cloud(gaussians: Gaussians, most: int = MOST_POINTS) -> SparseCloud:
    """The centres of the Gaussians that are more opaque than not, or as many of them as `most`, the same each time."""
    rows = np.flatnonzero(opacity_of(gaussians) >= _LEAST_OPACITY)
    if len(rows) > most:
        rows = np.sort(np.random.default_rng(0).choice(rows, most, replace=False))
    return SparseCloud(gaussians.mean[rows].astype(np.float64), as_bytes(255.0 * gaussians.colour[rows]))


def write_cloud(path: Path, cloud: SparseCloud) -> None:
    """Write it as a PLY with colours. Raises OSError."""
    rows = np.zeros(len(cloud.points_w), _ROW)
    rows["position"], rows["colour"] = cloud.points_w, cloud.colours
    with atomic_file(path) as file:
        file.write(_HEADER.format(count=len(rows)).encode("ascii"))
        file.write(rows.tobytes())
