"""Record3D's .r3d, a zip with metadata, rgbd/0.jpg and rgbd/0.depth; or a folder into which one was unpacked.

Source: https://record3d.app and https://github.com/marek-simonik/record3d. metadata is JSON: w, h, K column by column,
perFrameIntrinsicCoeffs (fx, fy, cx, cy), fps, dw, dh, poses (qx qy qz qw px py pz; the camera's y axis up, z back).
Depth is float32 in metres, compressed by LZFSE, zlib or not at all, and shows what colour shows. Poses are ARKit's.
"""

from __future__ import annotations

import contextlib
import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import image_files as images
from tgslam.datasets import json_files
from tgslam.datasets.calibration import Calibration, of_matrix, resolve, typical
from tgslam.datasets.layout import Layout
from tgslam.datasets.listing import USUAL_RATE_HZ
from tgslam.datasets.pose_rows import OPENGL_CAMERA, trajectory_of_matrices
from tgslam.datasets.stored import StoredRecording
from tgslam.errors import DatasetError, FrameError
from tgslam.geometry import matrix_from_quat_wxyz
from tgslam.types import Trajectory

_COLOUR = re.compile(r"rgbd/(\d+)\.jpg")
_MOST_BYTES = 1 << 28  # of one member
_KNOWN_SIZES = {256 * 192: (192, 256), 640 * 480: (480, 640)}  # width, height of older files, which do not say
_LZFSE_START = b"bvx"


def open_record3d(path: Path, config: DatasetConfig) -> StoredRecording:
    """A file or folder. Raises DatasetError for one that is damaged or lacks metadata."""
    files = _Files(path)
    name = f"{path}: metadata"
    try:
        metadata = json_files.parse_object(files.read("metadata"), name)
    except FrameError as error:
        raise DatasetError(f"{error}; it is no recording of Record3D") from error
    numbers = sorted(int(match[1]) for match in map(_COLOUR.fullmatch, files.names) if match)
    if not numbers:
        raise DatasetError(f"{path}: holds no rgbd/0.jpg; export the recording as .r3d again")
    frames = _Record3dFrames(files, metadata, numbers, name)
    return StoredRecording(
        path.stem,
        frames,
        resolve(config, _calibration(metadata, numbers, name), ""),
        1.0,
        lambda: _poses(metadata, numbers, frames.times_s, name),
    )


class _Files:
    """Members of a zip, or files of a folder, by their names."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._zip: zipfile.ZipFile | None = None
        if path.is_dir():
            self.names = [file.relative_to(path).as_posix() for file in (path / "rgbd").glob("*.jpg")]
            return
        try:
            self._zip = zipfile.ZipFile(path)
            self.names = self._zip.namelist()
        except (zipfile.BadZipFile, ValueError, NotImplementedError) as cause:
            raise DatasetError(f"{path}: not a zip file that can be read ({cause}); copy the .r3d again") from cause

    def read(self, name: str) -> bytes:
        """Raises FrameError."""
        try:
            if self._zip is None:
                return (self.path / name).read_bytes()
            if self._zip.getinfo(name).file_size > _MOST_BYTES:
                raise FrameError(f"{self.path}: {name}: over {_MOST_BYTES >> 20} MiB when unpacked")
            return self._zip.read(name)
        except KeyError:
            raise FrameError(f"{self.path}: {name}: is not in it") from None
        except (OSError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError) as cause:
            raise FrameError(f"{self.path}: {name}: cannot be read ({cause})") from cause


class _Record3dFrames:
    """See `StoredFrames`."""

    def __init__(self, files: _Files, metadata: dict[str, Any], numbers: list[int], name: str) -> None:
        self._files, self._numbers = files, numbers
        self._times_s = _times_s(metadata, numbers, name)
        sizes = [int(json_files.number(metadata, key, name, 0.0)) for key in ("dw", "dh")]
        self._depth_size = (sizes[0], sizes[1]) if min(sizes) > 0 else None

    @property
    def times_s(self) -> Sequence[float]:
        return self._times_s

    def names(self, index: int) -> tuple[str, str]:
        number, path = self._numbers[index], self._files.path
        return f"{path}: rgbd/{number}.jpg", f"{path}: rgbd/{number}.depth"

    def colour(self, index: int) -> NDArray[np.uint8]:
        data = self._files.read(f"rgbd/{self._numbers[index]}.jpg")
        return images.decode_colour(data, self.names(index)[0])

    def depth(self, index: int) -> NDArray[Any]:
        name = self.names(index)[1]
        data = _decompressed(self._files.read(f"rgbd/{self._numbers[index]}.depth"), name)
        size = self._depth_size or _KNOWN_SIZES.get(len(data) // 4)
        if size is None or len(data) != 4 * size[0] * size[1]:
            raise FrameError(f"{name}: has {len(data)} bytes, which is not the size of a depth image of this recording")
        return np.frombuffer(data, "<f4").reshape(size[1], size[0]).copy()


def _decompressed(data: bytes, name: str) -> bytes:
    if data.startswith(_LZFSE_START):
        try:
            import lzfse
        except ImportError:
            raise FrameError(
                f"{name}: is compressed by LZFSE; install what reads it: pip install tgslam[record3d]"
            ) from None
        if int.from_bytes(data[4:8], "little") > _MOST_BYTES:
            raise FrameError(f"{name}: over {_MOST_BYTES >> 20} MiB when unpacked")
        try:
            return bytes(lzfse.decompress(data))
        except (lzfse.error, MemoryError, ValueError) as cause:
            raise FrameError(f"{name}: damaged LZFSE data") from cause
    with contextlib.suppress(zlib.error):
        return zlib.decompressobj().decompress(data, _MOST_BYTES)
    return data


def _calibration(metadata: dict[str, Any], numbers: list[int], name: str) -> Calibration:
    size = int(json_files.number(metadata, "w", name)), int(json_files.number(metadata, "h", name))
    if metadata.get("perFrameIntrinsicCoeffs"):
        each = json_files.numbers(metadata, "perFrameIntrinsicCoeffs", name, (-1, 4))
        return typical(each[[number for number in numbers if number < len(each)] or [0]], size, name)
    return of_matrix(json_files.numbers(metadata, "K", name, (3, 3)).T, size)


def _times_s(metadata: dict[str, Any], numbers: list[int], name: str) -> list[float]:
    if metadata.get("frameTimestamps"):
        stamps = json_files.numbers(metadata, "frameTimestamps", name, (-1,))
        if len(stamps) > numbers[-1] and (np.diff(stamps[numbers]) > 0).all():
            return [float(stamps[number]) for number in numbers]
    rate_hz = json_files.number(metadata, "fps", name, USUAL_RATE_HZ)
    return [number / (rate_hz if rate_hz > 0 else USUAL_RATE_HZ) for number in numbers]


def _poses(metadata: dict[str, Any], numbers: list[int], times_s: Sequence[float], name: str) -> Trajectory | None:
    if not metadata.get("poses"):
        return None
    rows = json_files.numbers(metadata, "poses", name, (-1, 7))
    known = [place for place, number in enumerate(numbers) if number < len(rows)]
    rows = rows[[numbers[place] for place in known]]
    lengths = np.linalg.norm(rows[:, :4], axis=1, keepdims=True)
    rows[~(lengths[:, 0] > 1e-6)] = np.nan
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3] = matrix_from_quat_wxyz(rows[:, [3, 0, 1, 2]])
    T[:, :3, 3] = rows[:, 4:]
    return trajectory_of_matrices([times_s[place] for place in known], T @ OPENGL_CAMERA, name)


def _recognises(path: Path) -> bool:
    if path.is_dir():
        return (path / "metadata").is_file() and (path / "rgbd").is_dir()
    return path.suffix.lower() == ".r3d"


RECORD3D = Layout("record3d", "*.r3d", _recognises, open_record3d, is_file=True)
