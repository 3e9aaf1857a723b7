"""COLMAP's sparse model: cameras, images and points3D, as text or binary, with the images beside it.

Poses are world to camera, and pixels have their centres at halves. The points have no tracks: nobody matched features.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.exports.run_content import View
from tgslam.exports.sparse_cloud import SparseCloud
from tgslam.files.atomic import atomic_file
from tgslam.geometry import inverse, quat_wxyz_from_matrix
from tgslam.output.pictures import write_colour

MODEL = Path("sparse") / "0"
IMAGES = Path("images")
_FILES = ("cameras", "images", "points3D")
_PINHOLE = 1  # COLMAP's number of that camera model
_CAMERA_ID = 1
_ERROR_UNKNOWN = -1.0


@dataclass(frozen=True)
class _Image:
    number: int  # from 1
    name: str
    quat_wxyz: NDArray[np.float64]  # [4] world to camera
    translation_m: NDArray[np.float64]  # [3]


def write_colmap(folder: Path, camera: Camera, views: Iterable[View], cloud: SparseCloud, *, text: bool) -> None:
    """Write images/ and then sparse/0/; a model that is there already goes first. Raises OSError."""
    (folder / IMAGES).mkdir(parents=True, exist_ok=True)
    (folder / MODEL).mkdir(parents=True, exist_ok=True)
    for name in _FILES:
        for suffix in (".bin", ".txt"):
            (folder / MODEL / (name + suffix)).unlink(missing_ok=True)
    images = [_write_image(folder, view) for view in views]
    write = _text if text else _binary
    for name, data in zip(_FILES, write(camera, images, cloud), strict=True):
        with atomic_file(folder / MODEL / (name + (".txt" if text else ".bin"))) as file:
            file.write(data)


def _write_image(folder: Path, view: View) -> _Image:
    name = f"frame_{view.number:06d}.png"
    write_colour(folder / IMAGES / name, view.frame.colour)
    T_cw = inverse(view.T_wc)
    return _Image(view.number + 1, name, quat_wxyz_from_matrix(T_cw[:3, :3]), T_cw[:3, 3])


def _parameters(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5


def _text(camera: Camera, images: list[_Image], cloud: SparseCloud) -> tuple[bytes, bytes, bytes]:
    values = " ".join(f"{value:.17g}" for value in _parameters(camera))
    cameras = f"# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n{_CAMERA_ID} PINHOLE {camera.width} {camera.height} {values}\n"
    rows = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# POINTS2D[] as X Y POINT3D_ID: none\n"]
    for image in images:
        pose = " ".join(f"{value:.17g}" for value in (*image.quat_wxyz, *image.translation_m))
        rows.append(f"{image.number} {pose} {_CAMERA_ID} {image.name}\n\n")
    points = ["# POINT3D_ID X Y Z R G B ERROR TRACK[]\n"]
    for number, (point, colour) in enumerate(zip(cloud.points_w, cloud.colours.tolist(), strict=True), start=1):
        place = " ".join(f"{value:.9g}" for value in point)
        points.append(f"{number} {place} {colour[0]} {colour[1]} {colour[2]} {_ERROR_UNKNOWN:g}\n")
    return cameras.encode(), "".join(rows).encode(), "".join(points).encode()


def _binary(camera: Camera, images: list[_Image], cloud: SparseCloud) -> tuple[bytes, bytes, bytes]:
    """Little-endian without padding, a count before everything of which there may be several."""
    size = (_CAMERA_ID, _PINHOLE, camera.width, camera.height)
    cameras = struct.pack("<QiiQQ4d", 1, *size, *_parameters(camera))
    rows = [struct.pack("<Q", len(images))]
    for image in images:
        rows.append(struct.pack("<i7di", image.number, *image.quat_wxyz, *image.translation_m, _CAMERA_ID))
        rows.append(image.name.encode() + b"\0" + struct.pack("<Q", 0))
    kind = [("number", "<u8"), ("place", "<f8", 3), ("colour", "u1", 3), ("error", "<f8"), ("track", "<u8")]
    points = np.zeros(len(cloud.points_w), kind)
    points["number"] = np.arange(1, len(points) + 1)
    points["place"], points["colour"], points["error"] = cloud.points_w, cloud.colours, _ERROR_UNKNOWN
    return cameras, b"".join(rows), struct.pack("<Q", len(points)) + points.tobytes()
