"""ScanNet as its tools export it: color/0.jpg, depth/0.png, pose/0.txt, intrinsic/intrinsic_color.txt and the like.

Source: https://github.com/ScanNet/ScanNet. Depth is in millimetres, smaller than colour, and of a camera with its own
intrinsics. Poses are 4x4 camera-to-world, -inf where tracking was lost.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import image_files as images
from tgslam.datasets.calibration import Calibration, depth_camera, of_matrix, resolve
from tgslam.datasets.layout import Layout
from tgslam.datasets.layouts.bundle_fusion import motion_between
from tgslam.datasets.listing import Numbered, at_usual_rate, numbered_files, pairs_by_number
from tgslam.datasets.pose_rows import poses_of_files, read_matrix
from tgslam.datasets.stored import MILLIMETRES, ImageFrames, StoredRecording
from tgslam.geometry import inverse
from tgslam.types import Matrix4


def open_scannet(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A scene's folder. Raises DatasetError for missing images or intrinsics."""
    colour, depth = (numbered_files(folder / kind, r"(\d+)\.(?:jpg|png)") for kind in ("color", "depth"))
    pairs = pairs_by_number(colour, depth, folder, "color/0.jpg and depth/0.png")
    frames = ImageFrames(at_usual_rate(pairs))
    cameras = {kind: _calibration(folder, kind, pairs) for kind in ("color", "depth")}
    T_colour, T_depth = (_extrinsic(folder, kind) for kind in ("color", "depth"))
    T_colour_depth = motion_between(T_colour, T_depth, str(folder / "intrinsic"))
    pose_paths = [folder / "pose" / f"{pair.colour.stem}.txt" for pair in pairs]
    return StoredRecording(
        folder.resolve().name,
        frames,
        resolve(config, cameras["color"], ""),
        MILLIMETRES,
        poses_of_files(pose_paths, frames.times_s, inverse(T_colour_depth)),
        depth_camera(cameras["color"], cameras["depth"], T_colour_depth),
    )


def _calibration(folder: Path, kind: str, pairs: list[Numbered]) -> Calibration:
    """The file does not say for which size of image: it is that of the first image that can be read."""
    path = folder / "intrinsic" / f"intrinsic_{kind}.txt"
    paths = [pair.colour if kind == "color" else pair.depth for pair in pairs]
    return of_matrix(read_matrix(path), images.size_of_first(paths))


def _extrinsic(folder: Path, kind: str) -> Matrix4:
    path = folder / "intrinsic" / f"extrinsic_{kind}.txt"
    return read_matrix(path) if path.is_file() else np.eye(4)


def _recognises(folder: Path) -> bool:
    return all((folder / kind).is_dir() for kind in ("color", "depth", "intrinsic"))


SCANNET = Layout("scannet", "folders color, depth and intrinsic", _recognises, open_scannet)
