"""7-Scenes: frame-000000.color.png, .depth.png and .pose.txt in a folder seq-01, one of several of a scene.

Source: https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/. Depth is in millimetres, 65535 = none,
and not registered to colour. The published intrinsics, 585, 585, 320, 240, are the depth camera's, and so are the
poses. The colour camera and the motion between the two are those that the data set's evaluations use.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import image_files as images
from tgslam.datasets.calibration import Calibration, DepthCamera, resolve
from tgslam.datasets.layout import Layout
from tgslam.datasets.listing import Numbered, at_usual_rate, numbered_files, pairs_by_number
from tgslam.datasets.pose_rows import poses_of_files
from tgslam.datasets.stored import MILLIMETRES, ImageFrames, StoredRecording
from tgslam.errors import DatasetError
from tgslam.geometry import inverse

COLOUR, DEPTH = r"frame-(\d+)\.color\.(?:png|jpg|jpeg)", r"frame-(\d+)\.depth\.(?:png|pgm|tiff?)"
NO_DEPTH = 65535
_SIZE = (640, 480)
_CALIBRATION = Calibration(525.0, 525.0, 320.0, 240.0, (), _SIZE)
_T_COLOUR_DEPTH = np.array(
    [
        [0.99996518012567637, 0.0026765126468950343, -0.0079041012313000904, -0.025558943178152542],
        [-0.00274093112813167, 0.99996302803027592, -0.0081504520778013286, 0.00010109636268061706],
        [0.0078819942130445332, 0.0081718328771890631, 0.99993554558014031, 0.0020318321729487039],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
_DEPTH_CAMERA = DepthCamera(Calibration(585.0, 585.0, 320.0, 240.0, (), _SIZE), _T_COLOUR_DEPTH)


def open_seven_scenes(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A sequence's folder, or a scene's with one sequence. Raises DatasetError for missing images."""
    sequence = _sequence(folder)
    pairs = frame_pairs(sequence)
    frames = ImageFrames(at_usual_rate(pairs), read_depth)
    poses = poses_of_files(pose_files(pairs), frames.times_s, inverse(_T_COLOUR_DEPTH))
    name = f"{sequence.resolve().parent.name}-{sequence.resolve().name}"
    return StoredRecording(name, frames, resolve(config, _CALIBRATION, ""), MILLIMETRES, poses, _DEPTH_CAMERA)


def frame_pairs(folder: Path) -> list[Numbered]:
    """Frames called frame-000000.color and .depth. Raises DatasetError without any."""
    colour, depth = numbered_files(folder, COLOUR), numbered_files(folder, DEPTH)
    return pairs_by_number(colour, depth, folder, "frame-000000.color.png and frame-000000.depth.png")


def pose_files(pairs: list[Numbered]) -> list[Path]:
    """frame-000000.pose.txt beside the colour image of each frame; they need not exist."""
    return [pair.colour.with_name(pair.colour.name.split(".")[0] + ".pose.txt") for pair in pairs]


def read_depth(path: Path) -> NDArray[Any]:
    """Depth in which 65535 too says that there is none. Raises FrameError."""
    raw = images.read_raw_depth(path)
    raw[raw == NO_DEPTH] = 0
    return raw


def _sequence(folder: Path) -> Path:
    if numbered_files(folder, COLOUR):
        return folder
    found = _sequences(folder)
    if len(found) > 1:
        raise DatasetError(f"{folder}: holds sequences {found[0].name} to {found[-1].name}; name one of them")
    return found[0] if found else folder


def _sequences(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("seq-*") if numbered_files(path, COLOUR))


def _recognises(folder: Path) -> bool:
    return bool(numbered_files(folder, COLOUR) and numbered_files(folder, DEPTH)) or bool(_sequences(folder))


SEVEN_SCENES = Layout("7scenes", "frame-000000.color.png and .depth.png", _recognises, open_seven_scenes)
