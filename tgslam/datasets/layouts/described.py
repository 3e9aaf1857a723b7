"""Any folder of colour and depth images, with a recording.yaml that says what they are; see docs/recordings.md.

Without that file, folders called rgb, color, colour, image or images, and depth or depths, hold the images, and the
settings have to give the camera.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tgslam.config.input_settings import DatasetConfig
from tgslam.config.yaml_text import YamlTextError, parse_yaml
from tgslam.datasets.calibration import Calibration, DepthCamera, resolve
from tgslam.datasets.groundtruth import read_groundtruth
from tgslam.datasets.layout import Layout
from tgslam.datasets.listing import DEPTH_SUFFIXES, IMAGE_SUFFIXES, USUAL_RATE_HZ, natural_order
from tgslam.datasets.lists import ImagePair
from tgslam.datasets.named_files import named_file
from tgslam.datasets.pose_rows import OPENGL_CAMERA, read_numbers, turned
from tgslam.datasets.stored import MILLIMETRES, ImageFrames, StoredRecording
from tgslam.datasets.time_matching import associate_times
from tgslam.errors import ConfigError, DatasetError
from tgslam.types import Trajectory

DESCRIPTION = "recording.yaml"
_KEYS = {"colour", "depth", "depth_scale", "camera", "depth_camera", "rate", "times", "poses", "axes"}
_CAMERA_KEYS = {"fx", "fy", "cx", "cy", "distortion", "width", "height", "T_colour_depth"}
_PLAIN = {"colour": ("rgb", "color", "colour", "image", "images"), "depth": ("depth", "depths")}
_TIME = re.compile(r"\d+\.\d+")
_AXES = {"opencv": np.eye(4), "opengl": OPENGL_CAMERA}


def open_described(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A folder. Raises ConfigError for what its recording.yaml says, DatasetError for missing images."""
    path = folder / DESCRIPTION
    said = _read(path) if path.is_file() else {}
    colour, depth = (_images(folder, said, kind, path) for kind in ("colour", "depth"))
    if not said and all(_TIME.fullmatch(file.stem) for file in (*colour, *depth)):
        said = {"times": "names"}
    pairs = _pairs(colour, depth, said, config.expert.depth_tolerance_s, path)
    frames = ImageFrames(pairs)
    camera = said.get("camera")
    calibration = None if camera is None else _calibration(camera, f"{path}: camera")
    return StoredRecording(
        folder.resolve().name,
        frames,
        resolve(config, calibration, f"or give {path} a camera with fx, fy, cx and cy"),
        _positive(said, "depth_scale", MILLIMETRES, path),
        _poses(folder, said, frames.times_s, path),
        _depth_camera(said.get("depth_camera"), path),
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        said = parse_yaml(path.read_text(encoding="utf-8-sig"))
    except (UnicodeDecodeError, YamlTextError) as cause:
        line = getattr(cause, "line", None)
        raise ConfigError(f"{path}{'' if line is None else f':{line}'}: {cause}") from cause
    if isinstance(said, dict) and "color" in said:
        said["colour"] = said.pop("color")
    return _mapping(said, _KEYS, str(path))


def _mapping(value: object, keys: set[str], name: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{name}: must hold `key: value`, with keys of {', '.join(sorted(keys))}")
    unknown = sorted(str(key) for key in value if key not in keys)
    if unknown:
        raise ConfigError(f"{name}: {unknown[0]!r} is not known; keys are {', '.join(sorted(keys))}")
    return {str(key): item for key, item in value.items()}


def _images(folder: Path, said: dict[str, Any], key: str, path: Path) -> list[Path]:
    """Files that a glob pattern such as rgb/*.png finds, in the order of their names."""
    pattern = said.get(key)
    if not said:
        return _plain_images(folder, key)
    if not isinstance(pattern, str):
        raise ConfigError(f"{path}: {key} must be a pattern of file names, such as {key}/*.png")
    named_file(folder, pattern, f"{path}: {key}")
    try:
        found = [file for file in folder.glob(pattern) if file.is_file()]
    except (ValueError, NotImplementedError) as cause:
        raise ConfigError(f"{path}: {key}: {pattern!r} is no pattern below the folder ({cause})") from cause
    if not found:
        raise DatasetError(f"{path}: {key}: no file matches {pattern!r}")
    return sorted(found, key=lambda file: natural_order(file.relative_to(folder).as_posix()))


def _plain_images(folder: Path, kind: str) -> list[Path]:
    """Images of the folder that is called as one of this kind."""
    place, suffixes = plain_folder(folder, kind), IMAGE_SUFFIXES if kind == "colour" else DEPTH_SUFFIXES
    files = [] if place is None else [file for file in place.iterdir() if file.suffix.lower() in suffixes]
    if not files:
        raise DatasetError(
            f"{folder}: found no {kind} images in a folder {' or '.join(_PLAIN[kind])}; a {DESCRIPTION} may say where "
            "they are"
        )
    return sorted(files, key=lambda file: natural_order(file.name))


def plain_folder(folder: Path, kind: str) -> Path | None:
    """The folder within `folder` that is called as one of images of this kind, "colour" or "depth"."""
    return next((folder / name for name in _PLAIN[kind] if (folder / name).is_dir()), None)


def _pairs(
    colour: Sequence[Path], depth: Sequence[Path], said: dict[str, Any], tolerance_s: float, path: Path
) -> list[ImagePair]:
    """times: "names" = a file's name is its time in s, and frames pair by time; else the k-th with the k-th."""
    if said.get("times") == "names":
        times = [np.array([_time_in_name(file, path) for file in files]) for files in (colour, depth)]
        orders = [np.argsort(series, kind="stable") for series in times]
        i, j = associate_times(times[0][orders[0]], times[1][orders[1]], tolerance_s)
        pairs = [
            ImagePair(float(times[0][a]), colour[a], depth[b]) for a, b in zip(orders[0][i], orders[1][j], strict=True)
        ]
        if not pairs:
            raise DatasetError(f"{path}: no depth image is within {tolerance_s:g} s of a colour image, by their names")
        return pairs
    if len(colour) != len(depth):
        raise DatasetError(
            f"{path}: {len(colour)} colour images, but {len(depth)} of depth; make them as many, or say times: names"
        )
    times_s = _listed_times(said, len(colour), path)
    return [ImagePair(t, a, b) for t, a, b in zip(times_s, colour, depth, strict=True)]


def _time_in_name(file: Path, path: Path) -> float:
    try:
        value = float(file.stem)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DatasetError(f"{path}: says times: names, but {file.name} is no time in seconds")
    return value


def _listed_times(said: dict[str, Any], count: int, path: Path) -> list[float]:
    if "times" not in said:
        rate_hz = _positive(said, "rate", USUAL_RATE_HZ, path)
        return [k / rate_hz for k in range(count)]
    if not isinstance(said["times"], str):
        raise ConfigError(f"{path}: times must be `names`, or a text file with a time for each frame, s")
    file = named_file(path.parent, said["times"], f"{path}: times")
    times_s = read_numbers(file)
    if len(times_s) != count or not (np.diff(times_s) > 0).all():
        raise DatasetError(f"{file}: expected {count} increasing times, found {len(times_s)} numbers")
    return [float(time_s) for time_s in times_s]


def _positive(said: dict[str, Any], key: str, default: float, path: Path) -> float:
    value = said.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise ConfigError(f"{path}: {key} must be a number above 0, not {value!r}")
    return float(value)


def _calibration(value: object, name: str) -> Calibration:
    camera = _mapping(value, _CAMERA_KEYS, name)
    try:
        fx, fy, cx, cy = (float(camera[key]) for key in ("fx", "fy", "cx", "cy"))
        distortion = tuple(float(item) for item in camera.get("distortion", ()))
        size = (int(camera["width"]), int(camera["height"])) if "width" in camera else None
    except KeyError as cause:
        raise ConfigError(f"{name}: has no {cause.args[0]}; fx, fy, cx and cy are needed, px") from None
    except (TypeError, ValueError) as cause:
        raise ConfigError(f"{name}: {cause}; its values are numbers, distortion is a list of them") from None
    return Calibration(fx, fy, cx, cy, distortion, size)


def _depth_camera(value: object, path: Path) -> DepthCamera | None:
    if value is None:
        return None
    name = f"{path}: depth_camera"
    calibration = _calibration(value, name)
    if calibration.size is None or calibration.distortion:
        raise ConfigError(f"{name}: needs width and height of the depth images, and no distortion")
    T = np.asarray(_mapping(value, _CAMERA_KEYS, name).get("T_colour_depth", np.eye(4)), object).ravel()
    try:
        return DepthCamera(calibration, T.astype(np.float64).reshape(4, 4))
    except (TypeError, ValueError):
        raise ConfigError(f"{name}: T_colour_depth must be the 16 numbers of a 4x4 matrix, row by row") from None


def _poses(folder: Path, said: dict[str, Any], times_s: Sequence[float], path: Path) -> Callable[[], Trajectory | None]:
    if "poses" not in said:
        return lambda: None
    if not isinstance(said["poses"], str) or said.get("axes", "opencv") not in _AXES:
        raise ConfigError(f"{path}: poses must be a file, and axes one of {', '.join(_AXES)}")
    file, axes = named_file(folder, said["poses"], f"{path}: poses"), _AXES[said.get("axes", "opencv")]

    def read() -> Trajectory:
        found = read_groundtruth(file, times_s)
        return Trajectory(found.timestamps_s, turned(found.T_wc, axes))

    return read


FOLDER = Layout("folder", DESCRIPTION, lambda folder: (folder / DESCRIPTION).is_file(), open_described)
