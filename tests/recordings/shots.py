"""Three frames with all that a recording can say of them, and what helps to write them down."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tgslam.geometry import se3_exp

W, H = 32, 24
FX, FY, CX, CY = 30.0, 31.0, 15.0, 11.5
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1.0]])
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
RATE = 30.0


@dataclass
class Shot:
    """A frame: smooth colour, which JPEG keeps, and depth in whole millimetres with two surfaces and a hole."""

    number: int
    colour: np.ndarray  # [H, W, 3] uint8 RGB
    depth_mm: np.ndarray  # [H, W] uint16
    T_wc: np.ndarray  # [4, 4]

    @property
    def time_s(self) -> float:
        return self.number / RATE

    @property
    def depth_m(self) -> np.ndarray:
        return self.depth_mm.astype(np.float32) / np.float32(1000)


def shots(width: int = W, height: int = H) -> list[Shot]:
    made = []
    for k in range(3):
        v, u = np.mgrid[0:height, 0:width] / np.array([height, width])[:, None, None]
        colour = np.stack([60 + 100 * u, 50 + 90 * v, 80 + 40 * u * v + 20 * k], -1).astype(np.uint8)
        depth = (1500 + 700 * u + 100 * k).astype(np.uint16)
        depth[: height // 2, width // 2 :] += 1500
        depth[: height // 4, : width // 4] = 0
        T = se3_exp([0.1 * k, 0.2 - 0.05 * k, -0.3 * k, 0.2 * k, 1.0, 0.3 * k])
        made.append(Shot(k, colour, depth, T))
    return made


def write_image(path: Path, image: np.ndarray) -> None:
    """Colour is RGB here."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded(image, path.suffix))


def encoded(image: np.ndarray, suffix: str) -> bytes:
    quality = [cv2.IMWRITE_JPEG_QUALITY, 98] if suffix == ".jpg" else []
    stored = image[..., ::-1] if image.ndim == 3 and image.shape[2] == 3 else image
    return cv2.imencode(suffix, np.ascontiguousarray(stored), quality)[1].tobytes()


def write_matrix(path: Path, matrix: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(" ".join(f"{x:.9f}" for x in row) for row in matrix) + "\n")


def write_json(path: Path, value: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def square(K: np.ndarray) -> np.ndarray:
    """[3, 3] in the corner of a [4, 4] identity."""
    T = np.eye(4)
    T[:3, :3] = K
    return T


def truncate(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def spoil(path: Path) -> None:
    path.write_text("{ this is no 1 file")


Damage = tuple[Callable[[Path], Any], str]  # of the recording's path; a pattern of the message


@dataclass
class Case:
    """A layout: how the three frames are written in it, and what is wrong with damaged ones."""

    format: str
    write: Callable[[Path], Path]  # a new folder -> the path to open
    damages: dict[str, Damage]
    settings: dict[str, Any] = field(default_factory=dict)  # of the dataset
    colour_steps: float = 0.01  # of 255, by which colour may be off
    intrinsics: tuple[float, float, float, float] = (FX, FY, CX, CY)
    times_s: tuple[float, ...] = (0.0, 1 / RATE, 2 / RATE)
    has_poses: bool = True
    name: str = ""  # of the case, where a format has several

    @property
    def label(self) -> str:
        return self.name or self.format
