"""ScanNet++, its iPhone: rgb/frame_000000.jpg, depth/frame_000000.png and pose_intrinsic_imu.json in the folder iphone.

Source: https://github.com/scannetpp/scannetpp, whose tool prepare_iphone_data makes the images of rgb.mkv and
depth.bin. Depth is in millimetres, 256x192, and shows what colour shows. `pose` is ARKit's, `aligned_pose` the same in
the laser scan's world; both are camera-to-world with the camera's y axis down.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import image_files as images
from tgslam.datasets import json_files
from tgslam.datasets.calibration import resolve, typical
from tgslam.datasets.layout import Layout
from tgslam.datasets.listing import USUAL_RATE_HZ, numbered_files, pairs_by_number
from tgslam.datasets.lists import ImagePair
from tgslam.datasets.pose_rows import trajectory_of_matrices
from tgslam.datasets.stored import MILLIMETRES, ImageFrames, StoredRecording
from tgslam.errors import DatasetError

_FILE = "pose_intrinsic_imu.json"
_EXPECTED = "rgb/frame_000000.jpg and depth/frame_000000.png, which ScanNet++'s tool prepare_iphone_data makes"


def open_scannetpp(folder: Path, config: DatasetConfig) -> StoredRecording:
    """A scene's folder, or its folder iphone. Raises DatasetError for missing images or a damaged JSON."""
    phone = _phone_folder(folder) or folder
    path = phone / _FILE
    described = json_files.read_object(path)
    colour, depth = (numbered_files(phone / kind, r"frame_(\d+)\.(?:jpg|png)") for kind in ("rgb", "depth"))
    found = pairs_by_number(colour, depth, phone, _EXPECTED)
    files = [file for file in found if isinstance(described.get(file.colour.stem), dict)]
    if not files:
        raise DatasetError(f"{path}: has no entry for any of the images, such as frame_000000")
    entries: list[dict[str, Any]] = [described[file.colour.stem] for file in files]
    times_s = _times_s(entries, [file.number for file in files], str(path))
    frames = ImageFrames([ImagePair(t, file.colour, file.depth) for t, file in zip(times_s, files, strict=True)])
    K = np.stack([json_files.numbers(entry, "intrinsic", str(path), (3, 3)) for entry in entries])
    size = images.size_of_first([file.colour for file in files])
    calibration = typical(K[:, [0, 1, 0, 1], [0, 1, 2, 2]], size, str(path))

    def poses() -> Any:
        key = "aligned_pose" if "aligned_pose" in entries[0] else "pose"
        T = [json_files.numbers(entry, key, str(path), (4, 4)) for entry in entries]
        return trajectory_of_matrices(times_s, np.stack(T), str(path))

    scene = phone.resolve().parent.name if phone.name == "iphone" else phone.resolve().name
    return StoredRecording(scene, frames, resolve(config, calibration, ""), MILLIMETRES, poses)


def _times_s(entries: list[dict[str, Any]], numbers: list[int], name: str) -> list[float]:
    """The phone's clock where all frames have one, in order."""
    if all("timestamp" in entry for entry in entries):
        found = [json_files.number(entry, "timestamp", name) for entry in entries]
        if (np.diff(found) > 0).all():
            return found
    return [number / USUAL_RATE_HZ for number in numbers]


def _phone_folder(folder: Path) -> Path | None:
    return next((place for place in (folder, folder / "iphone") if (place / _FILE).is_file()), None)


SCANNETPP = Layout("scannetpp", _FILE, lambda folder: _phone_folder(folder) is not None, open_scannetpp)
