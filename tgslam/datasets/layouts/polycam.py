"""Polycam's raw export: keyframes/images, depth and cameras, the latter JSON with intrinsics and pose.

Source: https://github.com/PolyCam/polyform. corrected_images and corrected_cameras, Polycam's own optimised ones, are
taken where both are there. Depth is in millimetres, smaller than colour, and shows what colour shows. Poses t_00 to
t_23 are ARKit's: camera-to-world, the camera's y axis up and z axis back. Names are times in microseconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import json_files
from tgslam.datasets.calibration import resolve, typical
from tgslam.datasets.layout import Layout
from tgslam.datasets.listing import Numbered, numbered_files, pairs_by_number
from tgslam.datasets.lists import ImagePair
from tgslam.datasets.pose_rows import OPENGL_CAMERA, trajectory_of_matrices
from tgslam.datasets.stored import MILLIMETRES, ImageFrames, StoredRecording
from tgslam.types import Trajectory

_EXPECTED = "keyframes/images/*.jpg and keyframes/depth/*.png; export the capture in raw form, in LiDAR mode"


def open_polycam(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A capture's folder. Raises DatasetError for missing images or a damaged camera."""
    keyframes = _keyframes(folder) or folder / "keyframes"
    prefix = "corrected_" if all((keyframes / f"corrected_{k}").is_dir() for k in ("images", "cameras")) else ""
    cameras = keyframes / f"{prefix}cameras"
    colour = numbered_files(keyframes / f"{prefix}images", r"(\d+)\.(?:jpg|png)")
    files = pairs_by_number(colour, numbered_files(keyframes / "depth", r"(\d+)\.png"), keyframes, _EXPECTED)
    paths = [cameras / f"{file.colour.stem}.json" for file in files]
    read = [json_files.read_object(path) for path in paths]
    intrinsics = _table(read, paths, ("fx", "fy", "cx", "cy"))
    width, height = (int(json_files.number(read[0], key, str(paths[0]))) for key in ("width", "height"))
    frames = ImageFrames(_timed(files))
    calibration = typical(intrinsics, (width, height), str(cameras))
    name = keyframes.resolve().parent.name
    return StoredRecording(
        name,
        frames,
        resolve(config, calibration, ""),
        MILLIMETRES,
        lambda: _poses(read, paths, frames.times_s),
    )


def _timed(files: Sequence[Numbered]) -> list[ImagePair]:
    """Seconds after the first frame."""
    return [ImagePair((file.number - files[0].number) * 1e-6, file.colour, file.depth) for file in files]


def _poses(cameras: list[dict[str, Any]], paths: list[Path], times_s: Sequence[float]) -> Trajectory:
    T = _table(cameras, paths, [f"t_{row}{column}" for row in range(3) for column in range(4)])
    return trajectory_of_matrices(times_s, T.reshape(-1, 3, 4) @ OPENGL_CAMERA, str(paths[0].parent))


def _table(cameras: list[dict[str, Any]], paths: list[Path], keys: Sequence[str]) -> NDArray[np.float64]:
    """[N, keys]"""
    named = zip(cameras, map(str, paths), strict=True)
    return np.array([[json_files.number(camera, key, name) for key in keys] for camera, name in named])


def _keyframes(folder: Path) -> Path | None:
    places = (folder / "keyframes", folder)
    names = (("cameras", "images"), ("corrected_cameras", "corrected_images"))
    return next((p for p in places if any(all((p / n).is_dir() for n in pair) for pair in names)), None)


POLYCAM = Layout("polycam", "keyframes/cameras", lambda folder: _keyframes(folder) is not None, open_polycam)
