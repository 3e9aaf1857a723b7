"""Recordings of Open3D's tools and Redwood: folders color, rgb or image, and depth; a JSON camera; a .log of poses.

Sources: https://www.open3d.org/docs/release/tutorial/reconstruction_system/ and http://redwood-data.org. The JSON holds
`intrinsic_matrix` column by column; without one the camera is PrimeSense's, which is Open3D's default. Depth is in
millimetres. Redwood's files are called by number and time in microseconds, 0000001-000000033369.jpg. A .log has for
each pose a row of three numbers, the first the frame's place, and a 4x4 camera-to-world matrix.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import json_files
from tgslam.datasets.calibration import Calibration, of_matrix, resolve
from tgslam.datasets.layout import Layout
from tgslam.datasets.listing import at_usual_rate, numbered_files, pairs_by_number
from tgslam.datasets.lists import ImagePair
from tgslam.datasets.pose_rows import read_numbers, trajectory_of_matrices
from tgslam.datasets.stored import MILLIMETRES, ImageFrames, StoredRecording
from tgslam.datasets.time_matching import associate_times
from tgslam.errors import DatasetError
from tgslam.types import Trajectory

_PRIMESENSE = Calibration(525.0, 525.0, 319.5, 239.5, (), (640, 480))
_COLOUR_FOLDERS = ("color", "rgb", "image", "colour")
_CAMERA_FILES = ("camera_primesense.json", "camera_intrinsic.json", "intrinsic.json", "intrinsics.json", "camera.json")
_COLOUR, _DEPTH = r"(\d+)(?:-\d+)?\.(?:jpg|jpeg|png)", r"(\d+)(?:-\d+)?\.(?:png|tiff?|npy)"
_REDWOOD = re.compile(r"\d+-(\d{6,})")  # number and time
_POSE_NUMBERS = 3 + 16


def open_open3d(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A recording's folder. Raises DatasetError for missing images or a damaged camera file."""
    colour_folder = _colour_folder(folder) or folder / _COLOUR_FOLDERS[0]
    colour, depth = numbered_files(colour_folder, _COLOUR), numbered_files(folder / "depth", _DEPTH)
    pairs = _pairs(folder, colour, depth, config.expert.depth_tolerance_s)
    camera_file = _camera_file(folder)
    calibration = _PRIMESENSE if camera_file is None else _calibration(camera_file)
    frames = ImageFrames(pairs)
    poses = partial(_poses, _log_file(folder), frames.times_s)
    return StoredRecording(folder.resolve().name, frames, resolve(config, calibration, ""), MILLIMETRES, poses)


def _pairs(folder: Path, colour: dict[int, Path], depth: dict[int, Path], tolerance_s: float) -> list[ImagePair]:
    """By the times in the files' names, as Redwood has them; else by number, at the usual rate."""
    files = pairs_by_number(colour, depth, folder, "color/00000.jpg and depth/00000.png")
    colour_s, depth_s = _times_s(colour), _times_s(depth)
    if colour_s is None or depth_s is None:
        return at_usual_rate(file._replace(number=place) for place, file in enumerate(files))
    i, j = associate_times(colour_s, depth_s, tolerance_s)
    if not len(i):
        raise DatasetError(f"{folder}: no depth image is within {tolerance_s:g} s of a colour image, by their names")
    images = list(colour.values()), list(depth.values())
    return [ImagePair(float(colour_s[a]), images[0][a], images[1][b]) for a, b in zip(i, j, strict=True)]


def _times_s(images: dict[int, Path]) -> NDArray[np.float64] | None:
    """Of images in order; None where the names do not tell."""
    found = [_REDWOOD.match(path.name) for path in images.values()]
    times_s = np.array([int(match[1]) for match in found if match]) * 1e-6
    return times_s if len(times_s) == len(images) and (np.diff(times_s) > 0).all() else None


def _calibration(path: Path) -> Calibration:
    camera, name = json_files.read_object(path), str(path)
    K = json_files.numbers(camera, "intrinsic_matrix", name, (3, 3)).T
    size = int(json_files.number(camera, "width", name)), int(json_files.number(camera, "height", name))
    return of_matrix(K, size)


def _poses(path: Path | None, times_s: Sequence[float]) -> Trajectory | None:
    if path is None:
        return None
    numbers = read_numbers(path)
    if numbers.size == 0 or numbers.size % _POSE_NUMBERS:
        raise DatasetError(f"{path}: expected {_POSE_NUMBERS} numbers a pose, found {numbers.size} in all")
    entries = numbers.reshape(-1, _POSE_NUMBERS)
    places = entries[:, 0]
    known = (places >= 0) & (places < len(times_s)) & (places % 1 == 0)
    if not known.any() or len(np.unique(places[known])) < known.sum():
        raise DatasetError(f"{path}: its poses do not begin with the places of frames, 0 to {len(times_s) - 1}")
    entries = entries[known][np.argsort(places[known])]
    return trajectory_of_matrices([times_s[int(place)] for place in entries[:, 0]], entries[:, 3:], str(path))


def _colour_folder(folder: Path) -> Path | None:
    return next((folder / name for name in _COLOUR_FOLDERS if (folder / name).is_dir()), None)


def _camera_file(folder: Path) -> Path | None:
    places = [place / name for place in (folder, folder.resolve().parent) for name in _CAMERA_FILES]
    return next((path for path in places if path.is_file()), None)


def _log_file(folder: Path) -> Path | None:
    named = [folder / "trajectory.log", folder / "scene" / "trajectory.log"]
    found = [path for path in named if path.is_file()] or sorted(folder.glob("*.log"))
    return found[0] if found else None


def _recognises(folder: Path) -> bool:
    colour = _colour_folder(folder)
    if colour is None or not (folder / "depth").is_dir():
        return False
    redwood = any(_REDWOOD.match(path.name) for path in colour.iterdir())
    return redwood or _camera_file(folder) is not None or (folder / "trajectory.log").is_file()


OPEN3D = Layout("open3d", "folders color and depth with camera_primesense.json or the like", _recognises, open_open3d)
