"""Bonn RGB-D Dynamic: the lists of the TUM benchmark in folders called rgbd_bonn_..., and a camera of its own.

Source: https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset/. Poses are those of the camera by motion capture.
"""

from __future__ import annotations

from pathlib import Path

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets.calibration import Calibration, resolve
from tgslam.datasets.groundtruth import groundtruth_file, poses_of_file
from tgslam.datasets.layout import Layout
from tgslam.datasets.stored import ImageFrames, StoredRecording
from tgslam.datasets.tum import DEPTH_UNITS, TUM, image_pairs

_DISTORTION = (0.039903, -0.099343, -0.000730, -0.000144, 0.0)
_CALIBRATION = Calibration(542.822841, 542.576870, 315.593520, 237.756098, _DISTORTION, (640, 480))


def open_bonn(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A sequence's folder. Raises DatasetError for missing or unusable lists."""
    frames = ImageFrames(image_pairs(folder, config.expert.depth_tolerance_s))
    poses = poses_of_file(groundtruth_file(folder), frames.times_s)
    return StoredRecording(folder.resolve().name, frames, resolve(config, _CALIBRATION, ""), DEPTH_UNITS, poses)


def _recognises(folder: Path) -> bool:
    return "bonn" in folder.resolve().name.lower() and TUM.recognises(folder)


BONN = Layout("bonn", "lists as TUM's in a folder rgbd_bonn_...", _recognises, open_bonn)
