"""A recording as a source: decoded frames made what the system takes, all from one pinhole camera."""

from __future__ import annotations

import logging
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import image_files as images
from tgslam.datasets.calibration import check_size
from tgslam.datasets.depth_camera import own_depth_camera, register_to
from tgslam.datasets.depth_scale import other_scale
from tgslam.datasets.resampling import DepthResampler, Resizer, in_view
from tgslam.datasets.stored import StoredFrames, StoredRecording
from tgslam.datasets.truth import SceneTruth
from tgslam.errors import DatasetError, FrameError
from tgslam.pixels import colour_as_float
from tgslam.types import Frame, Trajectory

_log = logging.getLogger(__name__)
_SAMPLE_IMAGES = 8  # of a recording


class FolderSource:
    """RGB-D frames from a recording on disk; it keeps where they are and nothing else of them."""

    def __init__(self, recording: StoredRecording, config: DatasetConfig) -> None:
        """Reads colour images until one tells the image size, and depth until one can be read.

        Raises DatasetError if there is none of either, or if depth has another shape than colour and nothing says where
        its camera is; and ConfigError if a calibration is for images of another size.
        """
        width, height = _image_size(recording.name, recording.frames)
        depth_size = _depth_size(recording.name, recording.frames, (width, height))
        calibration = recording.calibration
        check_size(calibration, width, height, recording.name)
        self._recording, self._config = recording, config
        self._times_s = recording.frames.times_s
        self._stored = calibration.camera(width, height)
        self._flips_rows = calibration.flips_rows
        self._undistorter = (
            images.Undistorter(width, height, calibration.matrix, calibration.distortion)
            if calibration.distortion
            else None
        )
        self._told_size = False  # that depth is of another one
        self._resizer = None if config.width in (0, width) else Resizer(self._stored, config.width, recording.name)
        own = own_depth_camera(config, recording, depth_size)
        straight = own is not None and own.is_concentric and not own.calibration.distortion
        self._resampler = DepthResampler(own.calibration, self.camera) if own and straight else None
        self._registration = (
            register_to(self.camera, own, own.calibration.size or depth_size) if own and not straight else None
        )
        if own is None:
            _require_same_shape(recording.name, (height, width), depth_size)

    @property
    def name(self) -> str:
        """The recording's name."""
        return self._recording.name

    @property
    def camera(self) -> Camera:
        """The camera after undistortion, flip and resizing."""
        return self._stored if self._resizer is None else self._resizer.camera

    @property
    def uses_kernels(self) -> bool:
        """Whether depth is registered to colour as frames are read."""
        return self._registration is not None

    @property
    def depth_units(self) -> float:
        """By how many units in a metre whole-number depth is read."""
        return self._config.depth_scale or self._recording.depth_units

    def __len__(self) -> int:
        return len(self._times_s)

    def read(self, index: int) -> Frame:
        """Decode frame `index`, undistort it, flip its rows where the format asks for it, resize it, and bring depth to
        colour.

        Raises FrameError for images that are missing, damaged, of the wrong kind or size, or without any depth in
        the configured range, and IndexError outside 0 <= index < len(self).
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {self.name}: it has frames 0 to {len(self) - 1}")
        frames = self._recording.frames
        rgb, raw = frames.colour(index), frames.depth(index)
        self._check_sizes(index, rgb.shape[:2], raw.shape)
        depth_m = self._depth_m(index, raw if self._registration is not None else self._depth(raw))
        if self._registration is not None:
            depth_m = self._registration(depth_m)
        return Frame(index, self._times_s[index], colour_as_float(self._colour(rgb)), depth_m)

    def groundtruth(self) -> Trajectory | None:
        """Camera-to-world poses of the recording, or None without them. Raises DatasetError."""
        return self._recording.poses()

    def truth(self) -> SceneTruth | None:
        """None: nobody has labelled the surfaces of a recording."""
        return None

    def _colour(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """As the source's camera sees it."""
        if self._undistorter is not None:
            rgb = self._undistorter.colour(rgb)
        if self._flips_rows:
            rgb = rgb[::-1]
        return rgb if self._resizer is None else self._resizer.colour(rgb)

    def _depth(self, raw: NDArray[Any]) -> NDArray[Any]:
        """As the source's camera sees it."""
        if self._resampler is not None:
            return self._resampler(raw)
        if raw.shape != self._stored.shape and not self._told_size:
            self._told_size = True
            _log.info("%s: depth is %dx%d, and is brought to colour's size", self.name, raw.shape[1], raw.shape[0])
        if self._undistorter is not None:
            raw = self._undistorter.depth(in_view(raw, self._stored.shape))
        return in_view(raw[::-1] if self._flips_rows else raw, self.camera.shape)

    def _depth_m(self, index: int, raw: NDArray[Any]) -> NDArray[np.float32]:
        config, units = self._config, self.depth_units
        depth_m = images.depth_in_metres(raw, units, config.min_depth_m, config.max_depth_m)
        if not depth_m.any():
            whole = f"check dataset.depth_scale{other_scale(raw, units)}"
            way_out = whole if raw.dtype.kind in "ui" else "float depth has to be in metres"
            raise FrameError(
                f"{self._recording.frames.names(index)[1]}: no pixel has a depth from {config.min_depth_m:g} to "
                f"{config.max_depth_m:g} m; if all frames say so, {way_out}"
            )
        return depth_m

    def _check_sizes(self, index: int, colour: tuple[int, ...], depth: tuple[int, ...]) -> None:
        colour_name, depth_name = self._recording.frames.names(index)
        brought = self._resampler or self._registration
        if brought is None and not _same_shape(colour, depth):
            raise FrameError(
                f"{depth_name}: depth is {depth[1]}x{depth[0]}, but its colour image is {colour[1]}x{colour[0]}; "
                "register depth to colour first"
            )
        if brought is not None and depth != brought.stored_shape:
            height, width = brought.stored_shape
            raise FrameError(f"{depth_name}: {depth[1]}x{depth[0]}, but the depth camera's images are {width}x{height}")
        expected = self._stored.shape
        if colour != expected:
            raise FrameError(f"{colour_name}: {colour[1]}x{colour[0]}, but the sequence is {expected[1]}x{expected[0]}")


def _same_shape(colour: tuple[int, ...], depth: tuple[int, ...]) -> bool:
    """Whether images [H, W] can show the same in pixels of another size: their sides have one ratio."""
    return abs(colour[0] * depth[1] - depth[0] * colour[1]) <= min(colour[1], depth[1])


def _require_same_shape(name: str, colour: tuple[int, int], depth_size: tuple[int, int]) -> None:
    """colour: height and width; depth_size: width and height. Raises DatasetError."""
    if not _same_shape(colour, depth_size[::-1]):
        raise DatasetError(
            f"{name}: depth images are {depth_size[0]}x{depth_size[1]}, colour images {colour[1]}x{colour[0]}: their "
            "shapes differ, so depth has a camera of its own; set dataset.depth_camera, or register depth to colour "
            "first"
        )


def _depth_size(name: str, frames: StoredFrames, colour: tuple[int, int]) -> tuple[int, int]:
    """Width and height of most depth images, by a few from all over the recording; those of colour if any has these.

    Raises DatasetError if none of them can be read.
    """
    count, first_error = len(frames.times_s), ""
    sizes: Counter[tuple[int, int]] = Counter()
    for index in range(0, count, max(1, count // _SAMPLE_IMAGES)):
        try:
            height, width = frames.depth(index).shape
            sizes[width, height] += 1
        except FrameError as error:
            first_error = first_error or str(error)
    if not sizes:
        raise DatasetError(f"{name}: its depth images cannot be read; the first: {first_error}")
    return colour if colour in sizes else sizes.most_common(1)[0][0]


def _image_size(name: str, frames: StoredFrames) -> tuple[int, int]:
    """Width and height of the first colour image that can be read."""
    first_error = ""
    for index in range(len(frames.times_s)):
        try:
            height, width = frames.colour(index).shape[:2]
        except FrameError as error:
            first_error = first_error or str(error)
        else:
            return width, height
    raise DatasetError(f"{name}: none of its {len(frames.times_s)} colour images can be read; the first: {first_error}")
