"""BundleFusion, and 3RScan: frames called as in 7-Scenes, beside an info.txt that states both cameras.

Source: http://graphics.stanford.edu/projects/bundlefusion/. info.txt has lines `name = values`: sizes, 4x4 intrinsics
and extrinsics of both cameras, and m_depthShift, the units of depth in a metre. Poses are the depth camera's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets.calibration import depth_camera, of_matrix, resolve
from tgslam.datasets.layout import Layout
from tgslam.datasets.layouts.seven_scenes import frame_pairs, pose_files, read_depth
from tgslam.datasets.listing import at_usual_rate
from tgslam.datasets.pose_rows import poses_of_files
from tgslam.datasets.stored import ImageFrames, StoredRecording
from tgslam.errors import DatasetError
from tgslam.geometry import inverse

_INFO_FILES = ("info.txt", "_info.txt")


def open_bundle_fusion(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A sequence's folder. Raises DatasetError for missing images or an info.txt that lacks something."""
    info = _Info(_info_file(folder) or folder / _INFO_FILES[0])
    pairs = frame_pairs(folder)
    frames = ImageFrames(at_usual_rate(pairs), read_depth)
    colour = of_matrix(info.matrix("m_calibrationColorIntrinsic"), info.size("color"))
    depth = of_matrix(info.matrix("m_calibrationDepthIntrinsic"), info.size("depth"))
    T_colour, T_depth = (info.matrix(f"m_calibration{kind}Extrinsic", np.eye(4)) for kind in ("Color", "Depth"))
    T_colour_depth = motion_between(T_colour, T_depth, str(info.path))
    (units,) = info.values("m_depthShift", 1)
    if not units > 0:
        raise DatasetError(f"{info.path}: m_depthShift is {units:g}, but depth has more than 0 units in a metre")
    poses = poses_of_files(pose_files(pairs), frames.times_s, inverse(T_colour_depth))
    return StoredRecording(
        folder.resolve().name,
        frames,
        resolve(config, colour, ""),
        units,
        poses,
        depth_camera(colour, depth, T_colour_depth),
    )


def motion_between(T_colour: NDArray[np.float64], T_depth: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """T_colour_depth [4, 4], of extrinsics that map each camera's frame to a common one; both may be zeros: unknown."""
    for T in (T_colour, T_depth):
        if not np.isfinite(T).all():
            raise DatasetError(f"{name}: its extrinsics are no finite numbers; get the file again")
    if not T_colour.any() or not T_depth.any():
        return np.eye(4)
    try:
        return np.asarray(np.linalg.inv(T_colour) @ T_depth)
    except np.linalg.LinAlgError:
        raise DatasetError(f"{name}: its extrinsics have no inverse; get the file again") from None


class _Info:
    """Lines `name = values` of an info.txt."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
        except OSError as cause:
            raise DatasetError(f"{path}: cannot be read ({cause.strerror}); it states the cameras") from cause
        self._values = {key.strip(): text.split() for key, _, text in (line.partition("=") for line in lines)}

    def values(self, key: str, count: int) -> NDArray[np.float64]:
        """Raises DatasetError for another count of numbers."""
        try:
            values = np.array([float(word) for word in self._values[key]])
        except (KeyError, ValueError):
            raise DatasetError(f"{self.path}: has no numbers for {key}; get the file again") from None
        if len(values) != count or not np.isfinite(values).all():
            raise DatasetError(f"{self.path}: {key} has {len(values)} numbers, expected {count} finite ones")
        return values

    def matrix(self, key: str, default: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """[4, 4]"""
        return default if default is not None and key not in self._values else self.values(key, 16).reshape(4, 4)

    def size(self, kind: str) -> tuple[int, int]:
        """Width and height of the images of "color" or "depth"."""
        (width,), (height,) = self.values(f"m_{kind}Width", 1), self.values(f"m_{kind}Height", 1)
        return int(width), int(height)


def _info_file(folder: Path) -> Path | None:
    return next((folder / name for name in _INFO_FILES if (folder / name).is_file()), None)


def _recognises(folder: Path) -> bool:
    return _info_file(folder) is not None and any(folder.glob("frame-*.color.*"))


BUNDLE_FUSION = Layout("bundlefusion", "frame-000000.color.jpg and info.txt", _recognises, open_bundle_fusion)
