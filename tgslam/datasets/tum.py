"""The TUM RGB-D benchmark's folders: rgb.txt, depth.txt, groundtruth.txt, or an association file for the lists."""

from __future__ import annotations

import re
from pathlib import Path

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets.calibration import Calibration, resolve
from tgslam.datasets.groundtruth import groundtruth_file, poses_of_file
from tgslam.datasets.layout import Layout
from tgslam.datasets.lists import (
    ASSOCIATION_FILES,
    ImagePair,
    find_association_file,
    has_image_numbers,
    pairs_from_associations,
    pairs_from_lists,
)
from tgslam.datasets.stored import ImageFrames, StoredRecording
from tgslam.errors import DatasetError

DEPTH_UNITS = 5000.0  # in a metre
_SIZE = (640, 480)
_FREIBURG = {  # the benchmark's published calibrations; freiburg3 is undistorted already
    "1": Calibration(517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633), _SIZE),
    "2": Calibration(520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172), _SIZE),
    "3": Calibration(535.4, 539.2, 320.1, 247.6, (), _SIZE),
}
_FREIBURG_NAME = re.compile(r"(?:freiburg|(?<![a-z])fr)([123])(?!\d)")


def open_tum(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A sequence folder. The camera is the config's, or the benchmark's own one named by the folder.

    `groundtruth.txt` is optional. Raises DatasetError for missing or unusable lists, and ConfigError if the camera is
    not known.
    """
    pairs = image_pairs(folder, config.expert.depth_tolerance_s)
    calibration = resolve(
        config,
        _freiburg_calibration(folder.resolve().name),
        "the folder's name has no freiburg1, freiburg2 or freiburg3 (fr1, fr2, fr3) to take it from; "
        "an ICL-NUIM folder needs dataset.format=icl",
    )
    frames = ImageFrames(pairs)
    poses = poses_of_file(groundtruth_file(folder), frames.times_s)
    return StoredRecording(folder.resolve().name, frames, calibration, DEPTH_UNITS, poses)


def _freiburg_calibration(folder_name: str) -> Calibration | None:
    found = _FREIBURG_NAME.search(folder_name.lower())
    return _FREIBURG[found.group(1)] if found else None


def image_pairs(folder: Path, tolerance_s: float) -> list[ImagePair]:
    """What the lists of a sequence folder, or else its association file, name. Raises DatasetError."""
    lists = [folder / "rgb.txt", folder / "depth.txt"]
    missing = [path.name for path in lists if not path.is_file()]
    if not missing:
        return pairs_from_lists(lists[0], lists[1], tolerance_s)
    associations = find_association_file(folder)
    if associations is not None:
        return pairs_from_associations(associations)
    raise DatasetError(
        f"{folder}: found no {' and no '.join(missing)}; dataset.format=tum needs rgb.txt and depth.txt, "
        f"or one of {', '.join(ASSOCIATION_FILES)}"
    )


def _recognises(folder: Path) -> bool:
    if (folder / "rgb.txt").is_file() and (folder / "depth.txt").is_file():
        return True
    associations = find_association_file(folder)
    return associations is not None and not has_image_numbers(associations)


TUM = Layout("tum", "rgb.txt and depth.txt", _recognises, open_tum)
