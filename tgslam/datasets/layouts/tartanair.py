"""TartanAir, V1 and V2: images and depth of the left camera of a trajectory such as P000.

Sources: https://theairlab.org/tartanair-dataset/ and https://tartanair.org. V1 has depth as float32 NPY in metres, V2
as PNG whose four bytes a pixel are one float32. Poses are north-east-down: x forward, y right, z down. Ours are x
right, y down, z forward. Images are 640x480 in V1 and 640x640 in V2, 90 degrees across.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import image_files as images
from tgslam.datasets.calibration import Calibration, resolve
from tgslam.datasets.layout import Layout
from tgslam.datasets.listing import Numbered, at_usual_rate, numbered_files, pairs_by_number
from tgslam.datasets.pose_rows import read_numbers
from tgslam.datasets.stored import ImageFrames, StoredRecording
from tgslam.errors import DatasetError, FrameError
from tgslam.files.tum_text import trajectory_from_rows, usable_pose_rows
from tgslam.types import Trajectory


class _Version(NamedTuple):
    """How the files of one camera are called, and its intrinsics."""

    camera: str
    calibration: Calibration


_VERSIONS = (
    _Version("left", Calibration(320.0, 320.0, 320.0, 240.0, (), (640, 480))),
    _Version("lcam_front", Calibration(320.0, 320.0, 320.0, 320.0, (), (640, 640))),
)
_NED_CAMERA = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # our camera's axes in the body's
_DEPTH_UNITS = 1.0


def open_tartanair(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A trajectory's folder. Raises DatasetError for missing images."""
    version = _version(folder) or _VERSIONS[0]
    pairs = _pairs(folder, version.camera)
    frames = ImageFrames(at_usual_rate(pairs), read_depth)
    parts = folder.resolve().parts
    name = "-".join(parts[-3:] if re.fullmatch(r"P\d+", parts[-1]) else parts[-1:])
    poses = partial(_poses, folder / f"pose_{version.camera}.txt", pairs)
    return StoredRecording(name, frames, resolve(config, version.calibration, ""), _DEPTH_UNITS, poses)


def read_depth(path: Path) -> NDArray[np.float32]:
    """NPY, or PNG with four bytes a pixel that are one float32 in metres. Raises FrameError."""
    if path.suffix.lower() != ".png":
        return _floats(images.read_raw_depth(path), path)
    stored = images.read_unchanged(path)
    if stored.ndim != 3 or stored.shape[2] != 4 or stored.dtype != np.uint8:
        raise FrameError(f"{path}: expected a PNG with four bytes a pixel, of which V2's depth is made")
    return np.ascontiguousarray(stored).view("<f4")[..., 0].astype(np.float32)


def _floats(raw: NDArray[Any], path: Path) -> NDArray[np.float32]:
    if raw.dtype.kind != "f":
        raise FrameError(f"{path}: depth of TartanAir is floats in metres, this is {raw.dtype}")
    return raw


def _pairs(folder: Path, camera: str) -> list[Numbered]:
    colour = numbered_files(folder / f"image_{camera}", rf"(\d+)_{camera}\.(?:png|jpg)")
    depth = numbered_files(folder / f"depth_{camera}", rf"(\d+)_{camera}(?:_depth)?\.(?:npy|png)")
    return pairs_by_number(colour, depth, folder, f"image_{camera}/000000_{camera}.png and its depth_{camera}")


def _poses(path: Path, pairs: list[Numbered]) -> Trajectory | None:
    """Row k of `tx ty tz qx qy qz qw` is of the k-th frame."""
    if not path.is_file():
        return None
    numbers = read_numbers(path)
    if numbers.size % 7 or numbers.size // 7 < len(pairs):
        raise DatasetError(f"{path}: expected 7 numbers for each of {len(pairs)} frames, found {numbers.size} in all")
    times_s = [pair.timestamp_s for pair in at_usual_rate(pairs)]
    rows = np.column_stack([times_s, numbers.reshape(-1, 7)[: len(pairs)]])
    usable = usable_pose_rows(rows)
    if not usable.any():
        raise DatasetError(f"{path}: none of its rows is a usable pose; remove the file to run without poses")
    trajectory = trajectory_from_rows(rows[usable])
    axes = np.eye(4)
    axes[:3, :3] = _NED_CAMERA
    return Trajectory(trajectory.timestamps_s, axes.T @ trajectory.T_wc @ axes)


def _version(folder: Path) -> _Version | None:
    folders = (version for version in _VERSIONS if (folder / f"depth_{version.camera}").is_dir())
    return next((version for version in folders if (folder / f"image_{version.camera}").is_dir()), None)


TARTANAIR = Layout(
    "tartanair", "image_left and depth_left", lambda folder: _version(folder) is not None, open_tartanair
)
