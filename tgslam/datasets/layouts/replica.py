"""Replica as rendered for iMAP and NICE-SLAM: results/frame*.jpg, results/depth*.png, traj.txt, cam_params.json.

Source: the data of https://github.com/cvg/nice-slam. The camera file lies in the sequence's folder or above it. Without
one the camera is that of all published sequences. Depth has 6553.5 units in a metre. traj.txt holds a 4x4
camera-to-world matrix a row, the camera's y axis down. Frames have no times; they count as taken at 30 Hz.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import json_files
from tgslam.datasets.calibration import Calibration, resolve
from tgslam.datasets.layout import Layout
from tgslam.datasets.listing import Numbered, at_usual_rate, numbered_files, pairs_by_number
from tgslam.datasets.pose_rows import read_numbers, trajectory_of_matrices
from tgslam.datasets.stored import ImageFrames, StoredRecording
from tgslam.errors import DatasetError
from tgslam.types import Trajectory

_CALIBRATION = Calibration(600.0, 600.0, 599.5, 339.5, (), (1200, 680))
_DEPTH_UNITS = 6553.5
_COLOUR, _DEPTH = r"frame_?(\d+)\.(?:jpg|jpeg|png)", r"depth_?(\d+)\.(?:png|tiff?|npy)"


def open_replica(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A sequence folder. Raises DatasetError for missing images or a damaged camera file."""
    results = _results(folder)
    colour, depth = numbered_files(results, _COLOUR), numbered_files(results, _DEPTH)
    pairs = pairs_by_number(colour, depth, results, "frame000000.jpg and depth000000.png")
    calibration, units = _camera(folder)
    frames = ImageFrames(at_usual_rate(pairs))
    return StoredRecording(
        folder.resolve().name, frames, resolve(config, calibration, ""), units, partial(_poses, folder, pairs)
    )


def _results(folder: Path) -> Path:
    return folder / "results" if (folder / "results").is_dir() else folder


def _camera(folder: Path) -> tuple[Calibration, float]:
    places = (folder, folder.resolve().parent)
    path = next((place / "cam_params.json" for place in places if (place / "cam_params.json").is_file()), None)
    if path is None:
        return _CALIBRATION, _DEPTH_UNITS
    camera = json_files.read_object(path).get("camera")
    if not isinstance(camera, dict):
        raise DatasetError(f"{path}: has no object 'camera' with w, h, fx, fy, cx, cy and scale")
    keys = ("w", "h", "fx", "fy", "cx", "cy")
    width, height, fx, fy, cx, cy = (json_files.number(camera, key, str(path)) for key in keys)
    units = json_files.number(camera, "scale", str(path), _DEPTH_UNITS)
    if units <= 0:
        raise DatasetError(f"{path}: 'scale' is {units:g}, but depth has more than 0 units in a metre")
    return Calibration(fx, fy, cx, cy, (), (int(width), int(height))), units


def _poses(folder: Path, pairs: list[Numbered]) -> Trajectory | None:
    """Row k of traj.txt is of image number k."""
    path = folder / "traj.txt"
    if not path.is_file():
        return None
    numbers = read_numbers(path)
    if numbers.size == 0 or numbers.size % 16:
        raise DatasetError(f"{path}: expected 16 numbers a row, found {numbers.size} in all; get the file again")
    matrices = numbers.reshape(-1, 4, 4)
    known = [pair for pair in pairs if pair.number < len(matrices)]
    times_s = [pair.timestamp_s for pair in at_usual_rate(known)]
    return trajectory_of_matrices(times_s, matrices[np.array([pair.number for pair in known], int)], str(path))


def _recognises(folder: Path) -> bool:
    results = _results(folder)
    return bool(numbered_files(results, _COLOUR)) and bool(numbered_files(results, _DEPTH))


REPLICA = Layout("replica", "results/frame*.jpg and results/depth*.png", _recognises, open_replica)
