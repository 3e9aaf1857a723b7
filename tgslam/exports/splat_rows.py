"""`.splat`: antimatter15's rows of 32 bytes, without a header.

A row is: position, 3 floats, m; standard deviations, 3 floats, m; red, green, blue and opacity as bytes; the unit
quaternion wxyz as bytes, 128 (q + 1). Rows go from large and opaque Gaussians to faint ones: viewers draw a file while
it loads.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tgslam.exports.quantised import as_bytes, opacity_of, unit_quat
from tgslam.files.atomic import atomic_file
from tgslam.types import Gaussians

ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])


def write_splat(path: Path, gaussians: Gaussians) -> None:
    """Write the map. Raises OSError."""
    opacity = opacity_of(gaussians)
    order = np.argsort(-(gaussians.log_scale.sum(axis=1, dtype=np.float64) + np.log(opacity)), kind="stable")
    rows = np.zeros(len(gaussians), ROW)
    rows["position"] = gaussians.mean
    rows["scale"] = np.exp(gaussians.log_scale)
    rows["rgba"] = as_bytes(255.0 * np.column_stack([gaussians.colour, opacity]))
    rows["rotation"] = as_bytes(128.0 * unit_quat(gaussians) + 128.0)
    with atomic_file(path) as file:
        file.write(rows[order].tobytes())
