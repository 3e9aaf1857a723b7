"""transforms.json of nerfstudio, with depth_file_path, or of instant-ngp and NeRFCapture, with depth_path.

Source: https://docs.nerf.studio/quickstart/data_conventions.html. Whole-number depth is in millimetres, or in units of
integer_depth_scale metres where that stands in the file, as for https://github.com/NVlabs/instant-ngp. Poses are
camera-to-world with the camera's y axis up and z axis back. Principal points count from the corner of the first pixel,
ours from its centre, half a pixel further. Frames come in the order of their names, at 30 Hz.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import json_files
from tgslam.datasets.calibration import Calibration, resolve, typical
from tgslam.datasets.layout import Layout
from tgslam.datasets.listing import USUAL_RATE_HZ, natural_order
from tgslam.datasets.lists import ImagePair
from tgslam.datasets.named_files import named_file
from tgslam.datasets.pose_rows import OPENGL_CAMERA, trajectory_of_matrices
from tgslam.datasets.stored import MILLIMETRES, ImageFrames, StoredRecording
from tgslam.errors import ConfigError, DatasetError

_FILE = "transforms.json"
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_WITHOUT_FISHEYE = re.compile(r"(?:SIMPLE_)?(?:PINHOLE|RADIAL)|OPENCV|PERSPECTIVE", re.IGNORECASE)


def open_nerfstudio(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A folder with transforms.json. Raises DatasetError for a damaged one, and where no frame has depth."""
    path = folder / _FILE
    described = json_files.read_object(path)
    frames = _frames_with_depth(described, path)
    pairs = []
    for place, frame in enumerate(frames):
        colour, depth = (named_file(folder, name, str(path)) for name in (frame["file_path"], _depth_name(frame)))
        pairs.append(ImagePair(place / USUAL_RATE_HZ, _with_suffix(colour), depth))
    stored = ImageFrames(pairs)

    def poses() -> Any:
        T = [json_files.numbers(frame, "transform_matrix", str(path), (-1, 4))[:3] for frame in frames]
        if any(len(matrix) != 3 for matrix in T):
            raise DatasetError(f"{path}: a transform_matrix has less than three rows")
        return trajectory_of_matrices(stored.times_s, np.stack(T) @ OPENGL_CAMERA, str(path))

    calibration = resolve(config, _calibration(described, frames, path), "")
    unit_m = json_files.number(described, "integer_depth_scale", str(path), 1.0 / MILLIMETRES)
    if unit_m <= 0:
        raise DatasetError(f"{path}: integer_depth_scale is {unit_m:g}, but a unit of depth is above 0 m")
    return StoredRecording(folder.resolve().name, stored, calibration, 1.0 / unit_m, poses)


def _frames_with_depth(described: Mapping[str, Any], path: Path) -> list[dict[str, Any]]:
    frames = described.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise DatasetError(f"{path}: has no list of frames")
    found = [f for f in frames if isinstance(f.get("file_path"), str) and isinstance(_depth_name(f), str)]
    if not found:
        raise DatasetError(f"{path}: none of its {len(frames)} frames has a depth_file_path; depth is needed")
    return sorted(found, key=lambda frame: natural_order(frame["file_path"]))


def _depth_name(frame: Mapping[str, Any]) -> Any:
    return frame.get("depth_file_path", frame.get("depth_path"))


def _calibration(described: Mapping[str, Any], frames: list[dict[str, Any]], path: Path) -> Calibration:
    model = described.get("camera_model", "PINHOLE")
    if not isinstance(model, str) or not _WITHOUT_FISHEYE.fullmatch(model):
        raise ConfigError(f"{path}: its camera_model is {model!r}, no pinhole camera; undistort the images first")
    name, merged = str(path), [{**described, **frame} for frame in frames]
    keys = ("fl_x", "fl_y", "cx", "cy")
    for frame in merged:
        frame.setdefault("fl_y", frame.get("fl_x"))
    intrinsics = np.array([[json_files.number(frame, key, name) for key in keys] for frame in merged])
    intrinsics[:, 2:] -= 0.5
    size = (int(json_files.number(merged[0], "w", name)), int(json_files.number(merged[0], "h", name)))
    distortion = tuple(json_files.number(merged[0], key, name, 0.0) for key in _DISTORTION)
    found = typical(intrinsics, size, name)
    return Calibration(found.fx, found.fy, found.cx, found.cy, distortion if any(distortion) else (), size)


def _with_suffix(path: Path) -> Path:
    """NeRF's files leave the suffix out."""
    return path if path.suffix else path.with_suffix(".png")


NERFSTUDIO = Layout("nerfstudio", _FILE, lambda folder: (folder / _FILE).is_file(), open_nerfstudio)
