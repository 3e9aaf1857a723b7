"""ScanNet's .sens files: all frames of a scene in one, colour as JPEG or PNG and depth as zlib's.

Source: https://github.com/ScanNet/ScanNet/tree/master/SensReader. Little-endian: a version, 4; the sensor's name; four
4x4 matrices; how colour and depth are compressed; their sizes; units of depth in a metre; the count of frames; then for
each a pose, two times in microseconds, two counts of bytes, and these. Only where frames begin is kept.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import image_files as images
from tgslam.datasets.calibration import depth_camera, of_matrix, resolve
from tgslam.datasets.image_header import MOST_PIXELS
from tgslam.datasets.layout import Layout
from tgslam.datasets.layouts.bundle_fusion import motion_between
from tgslam.datasets.listing import USUAL_RATE_HZ
from tgslam.datasets.pose_rows import trajectory_of_matrices, turned
from tgslam.datasets.stored import StoredRecording
from tgslam.errors import DatasetError, FrameError
from tgslam.geometry import inverse
from tgslam.types import Trajectory

_VERSION = 4
_RAW, _ZLIB = 0, 1  # depth
_PNG, _JPEG = 1, 2  # colour
_FRAME = struct.Struct("<64s4Q")


class _Header(NamedTuple):
    colour_kind: int
    depth_kind: int
    colour_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_units: float
    matrices: NDArray[np.float64]  # [4, 4, 4]: colour's intrinsics and extrinsics, and depth's


class _Entry(NamedTuple):
    """A frame's place in the file."""

    colour_at: int
    colour_bytes: int
    depth_bytes: int


def open_sens(path: Path, config: DatasetConfig) -> StoredRecording:
    """A file, or a folder with one. Frames that a cut took are left out.

    Raises DatasetError for a file that is damaged or of another kind.
    """
    path = _sens_in(path) or path
    with path.open("rb") as file:
        try:
            header, count = _read_header(file)
        except (struct.error, UnicodeDecodeError, ValueError) as cause:
            raise DatasetError(f"{path}: not a .sens file of version {_VERSION} ({cause}); get it again") from cause
        frames = _SensFrames(path, header, *_read_index(file, path, count))
    colour_K, colour_T, depth_K, depth_T = header.matrices
    T_colour_depth = motion_between(colour_T, depth_T, str(path))
    colour, depth = of_matrix(colour_K, header.colour_size), of_matrix(depth_K, header.depth_size)
    return StoredRecording(
        path.stem,
        frames,
        resolve(config, colour, ""),
        header.depth_units,
        lambda: frames.poses(inverse(T_colour_depth)),
        depth_camera(colour, depth, T_colour_depth),
    )


def _read_header(file: BinaryIO) -> tuple[_Header, int]:
    version, name_bytes = struct.unpack("<IQ", file.read(12))
    if version != _VERSION or name_bytes > 1 << 16:
        raise ValueError(f"it says version {version}")
    file.seek(name_bytes, 1)
    matrices = np.frombuffer(file.read(256), "<f4").astype(np.float64).reshape(4, 4, 4)
    colour_kind, depth_kind = struct.unpack("<ii", file.read(8))
    width, height, depth_width, depth_height = struct.unpack("<4I", file.read(16))
    units, count = struct.unpack("<fQ", file.read(12))
    if colour_kind not in (_PNG, _JPEG) or depth_kind not in (_RAW, _ZLIB):
        raise ValueError(f"its images are of kinds {colour_kind} and {depth_kind}, which are not known")
    if not 0 < depth_width * depth_height <= MOST_PIXELS or not units > 0:
        raise ValueError(f"depth of {depth_width}x{depth_height} px and {units:g} units in a metre")
    sizes = (width, height), (depth_width, depth_height)
    return _Header(colour_kind, depth_kind, *sizes, float(units), matrices), count


def _read_index(file: BinaryIO, path: Path, count: int) -> tuple[list[_Entry], list[float], NDArray[np.float64]]:
    """Places, times and poses of the frames that the file holds whole."""
    size = path.stat().st_size
    entries: list[_Entry] = []
    poses: list[NDArray[np.float32]] = []
    clock: list[float] = []
    while len(entries) < count and len(head := file.read(_FRAME.size)) == _FRAME.size:
        pose, colour_us, _, colour_bytes, depth_bytes = _FRAME.unpack(head)
        at = file.tell()
        if at + colour_bytes + depth_bytes > size:
            break
        entries.append(_Entry(at, colour_bytes, depth_bytes))
        poses.append(np.frombuffer(pose, "<f4").reshape(4, 4))
        clock.append(colour_us * 1e-6)
        file.seek(colour_bytes + depth_bytes, 1)
    if not entries:
        raise DatasetError(f"{path}: holds no whole frame of {count}; the file is cut off, get it again")
    if any(after <= before for before, after in pairwise(clock)):  # as in scenes without times
        clock = [k / USUAL_RATE_HZ for k in range(len(entries))]
    return entries, clock, np.stack(poses).astype(np.float64)


class _SensFrames:
    """See `StoredFrames`."""

    def __init__(
        self, path: Path, header: _Header, entries: list[_Entry], times_s: list[float], T: NDArray[np.float64]
    ) -> None:
        self._path, self._header, self._entries, self._times_s, self._T = path, header, entries, times_s, T

    @property
    def times_s(self) -> Sequence[float]:
        return self._times_s

    def names(self, index: int) -> tuple[str, str]:
        return f"{self._path}: colour of frame {index}", f"{self._path}: depth of frame {index}"

    def colour(self, index: int) -> NDArray[np.uint8]:
        entry = self._entries[index]
        return images.decode_colour(self._read(entry.colour_at, entry.colour_bytes), self.names(index)[0])

    def depth(self, index: int) -> NDArray[Any]:
        entry, name = self._entries[index], self.names(index)[1]
        width, height = self._header.depth_size
        data, expected = self._read(entry.colour_at + entry.colour_bytes, entry.depth_bytes), 2 * width * height
        if self._header.depth_kind == _ZLIB:
            try:
                data = zlib.decompressobj().decompress(data, expected)
            except zlib.error as cause:
                raise FrameError(f"{name}: damaged ({cause})") from cause
        if len(data) != expected:
            raise FrameError(f"{name}: has {len(data)} bytes, expected {expected} for {width}x{height} px")
        return np.frombuffer(data, "<u2").reshape(height, width).copy()

    def poses(self, axes: NDArray[np.float64]) -> Trajectory | None:
        """Camera to world; None where no frame has one."""
        if not np.isfinite(self._T).all(axis=(1, 2)).any() or not self._T.any():
            return None
        return trajectory_of_matrices(self._times_s, turned(self._T, axes), str(self._path))

    def _read(self, at: int, count: int) -> bytes:
        try:
            with self._path.open("rb") as file:
                file.seek(at)
                return file.read(count)
        except OSError as cause:
            raise FrameError(f"{self._path}: cannot be read ({cause.strerror})") from cause


def _sens_in(path: Path) -> Path | None:
    if path.is_dir():
        found = sorted(path.glob("*.sens"))
        return found[0] if len(found) == 1 else None
    return path if path.suffix.lower() == ".sens" else None


SENS = Layout("sens", "*.sens", lambda path: _sens_in(path) is not None, open_sens, is_file=True)
