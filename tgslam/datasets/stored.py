"""What a reader hands over: frames as a recording stores them, and what is known of its cameras and poses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tgslam.datasets import image_files as images
from tgslam.datasets.calibration import Calibration, DepthCamera
from tgslam.datasets.lists import ImagePair
from tgslam.types import Trajectory

MILLIMETRES = 1000.0  # units in a metre

RawDepth = NDArray[Any]  # [h, w]: whole numbers in units of the recording, or floats in metres; 0 = no measurement


class StoredFrames(Protocol):
    """Frames in order of time. They are decoded when they are asked for, and none is kept."""

    @property
    def times_s(self) -> Sequence[float]:
        """Of each frame: when its colour image was taken."""

    def names(self, index: int) -> tuple[str, str]:
        """How messages call the colour and the depth of a frame."""

    def colour(self, index: int) -> NDArray[np.uint8]:
        """[H, W, 3] RGB. Raises FrameError."""

    def depth(self, index: int) -> RawDepth:
        """See `RawDepth`; of another size than colour where the recording has it so. Raises FrameError."""


@dataclass(frozen=True)
class StoredRecording:
    """A recording of one moving camera, opened but not read."""

    name: str  # short, for titles and file names
    frames: StoredFrames
    calibration: Calibration  # of the colour images
    depth_units: float  # whole-number depth, units in a metre
    poses: Callable[[], Trajectory | None] = lambda: None  # camera to world; raises DatasetError
    depth_camera: DepthCamera | None = None  # None = depth is registered to colour, or shows the same field of view


class ImageFrames:
    """Frames of which colour and depth are a file each."""

    def __init__(
        self, pairs: Sequence[ImagePair], read_depth: Callable[[Path], RawDepth] = images.read_raw_depth
    ) -> None:
        """read_depth: for layouts that do not store depth as images of one channel."""
        self._pairs, self._read_depth = pairs, read_depth
        self._unused_bits = images.unused_bits_of_some([pair.colour for pair in pairs])

    @property
    def times_s(self) -> Sequence[float]:
        """See `StoredFrames.times_s`."""
        return [pair.timestamp_s for pair in self._pairs]

    def names(self, index: int) -> tuple[str, str]:
        """See `StoredFrames.names`: the paths."""
        return str(self._pairs[index].colour), str(self._pairs[index].depth)

    def colour(self, index: int) -> NDArray[np.uint8]:
        """See `StoredFrames.colour`."""
        return images.read_colour(self._pairs[index].colour, self._unused_bits)

    def depth(self, index: int) -> RawDepth:
        """See `StoredFrames.depth`."""
        return self._read_depth(self._pairs[index].depth)
