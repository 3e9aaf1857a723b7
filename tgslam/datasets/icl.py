"""ICL-NUIM folders in the TUM-compatible PNG layout: an association file with image numbers in place of times.

Handedness. ICL-NUIM publishes fy = -480: image rows count downwards, the camera's y axis points up, so its frame (x
right, y up, z forward) and its world are left-handed. Reversing the rows of each image gives, with the same numbers, a
camera with fy = +480 whose y axis runs with the rows: pixel, depth and published pose then agree in right-handed
arithmetic, and what is reconstructed is the office as in a mirror. The published poses need no change: their rotations
are proper, back-projected depth of distant frames coincides under them, and a trajectory estimated from the flipped
images aligns with the raw file by a rigid motion. Leaving the rows as they are and taking fy = +480 does neither.
"""

from __future__ import annotations

from pathlib import Path

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets.calibration import Calibration, resolve
from tgslam.datasets.groundtruth import groundtruth_file, poses_of_file
from tgslam.datasets.layout import Layout
from tgslam.datasets.lists import ASSOCIATION_FILES, find_association_file, has_image_numbers, pairs_from_associations
from tgslam.datasets.stored import ImageFrames, StoredRecording
from tgslam.datasets.tum import DEPTH_UNITS
from tgslam.errors import DatasetError

_CALIBRATION = Calibration(481.2, -480.0, 319.5, 239.5, (), (640, 480))


def open_icl(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A sequence folder. `Frame.timestamp_s` is the image number, as in the published ground truth's rows.

    The ground truth, optional, is `groundtruth.txt` or a single `*.gt.freiburg`. Raises DatasetError for a missing or
    unusable association file, and ConfigError for a camera that cannot be.
    """
    associations = find_association_file(folder)
    if associations is None:
        advice = (
            "it has an rgb.txt: try dataset.format=tum"
            if (folder / "rgb.txt").is_file()
            else "get the sequence in its TUM-compatible PNG form"
        )
        raise DatasetError(f"{folder}: found none of {', '.join(ASSOCIATION_FILES)} for dataset.format=icl; {advice}")
    pairs = pairs_from_associations(associations)
    calibration = resolve(config, _CALIBRATION, "")
    frames = ImageFrames(pairs)
    poses = poses_of_file(_groundtruth_file(folder), frames.times_s)
    return StoredRecording(folder.resolve().name, frames, calibration, DEPTH_UNITS, poses)


def _groundtruth_file(folder: Path) -> Path:
    """Of a folder without any, the one that it could have."""
    usual = groundtruth_file(folder)
    found = sorted(folder.glob("*.gt.freiburg"))
    return found[0] if len(found) == 1 and not usual.exists() else usual


def _recognises(folder: Path) -> bool:
    associations = find_association_file(folder)
    return associations is not None and has_image_numbers(associations)


ICL = Layout("icl", "associations.txt with image numbers", _recognises, open_icl)
