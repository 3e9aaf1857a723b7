"""A source over image files: pairs of colour and depth images, one camera, an optional ground truth file."""

from __future__ import annotations

import contextlib
import logging
from collections import Counter
from pathlib import Path

from tgslam.camera import Camera
from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets import image_files as images
from tgslam.datasets.calibration import Calibration, check_size
from tgslam.datasets.depth_camera import registration_of
from tgslam.datasets.depth_scale import other_scale
from tgslam.datasets.groundtruth import read_groundtruth
from tgslam.datasets.lists import ImagePair
from tgslam.datasets.truth import SceneTruth
from tgslam.errors import DatasetError, FrameError
from tgslam.pixels import colour_as_float
from tgslam.types import Frame, Trajectory

_log = logging.getLogger(__name__)
_SAMPLE_IMAGES = 4  # of a recording, that tell its colours' range and the size of its depth


class FolderSource:
    """RGB-D frames from image files; it keeps their paths and nothing else of them."""

    def __init__(
        self,
        name: str,
        pairs: list[ImagePair],
        calibration: Calibration,
        config: DatasetConfig,
        groundtruth: Path | None,
    ) -> None:
        """Reads colour images until one tells the image size.

        Raises DatasetError if there is none, or if depth has another shape than colour and nothing says where its
        camera is; and ConfigError if a calibration is for images of another size.
        """
        width, height = _image_size(name, pairs)
        self._unused_bits = _unused_bits(name, pairs)
        check_size(calibration, width, height, name)
        self._name = name
        self._camera = calibration.camera(width, height)
        self._depth_size = _depth_size(pairs, (width, height))
        self._registration = registration_of(config, calibration, self._camera, self._depth_size)
        self._pairs = pairs
        self._config = config
        self._groundtruth = groundtruth
        self._flips_rows = calibration.flips_rows
        self._undistorter = (
            images.Undistorter(width, height, calibration.matrix, calibration.distortion)
            if calibration.distortion
            else None
        )

    @property
    def name(self) -> str:
        """The folder's name."""
        return self._name

    @property
    def camera(self) -> Camera:
        """The camera after undistortion and flip."""
        return self._camera

    @property
    def uses_kernels(self) -> bool:
        """Whether depth is registered to colour as frames are read."""
        return self._registration is not None

    def __len__(self) -> int:
        return len(self._pairs)

    def read(self, index: int) -> Frame:
        """Decode frame `index`, undistort it, flip its rows where the format asks for it, and bring depth to colour.

        Raises FrameError for images that are missing, damaged, of the wrong kind or size, or without any depth in
        the configured range, and IndexError outside 0 <= index < len(self).
        """
        if not 0 <= index < len(self._pairs):
            raise IndexError(f"frame {index} of {self._name}: it has frames 0 to {len(self._pairs) - 1}")
        pair = self._pairs[index]
        rgb, raw = images.read_colour(pair.colour, self._unused_bits), images.read_raw_depth(pair.depth)
        self._check_sizes(pair, rgb.shape[:2], raw.shape)
        if self._undistorter is not None:
            rgb = self._undistorter.colour(rgb)
            raw = raw if self._registration is not None else self._undistorter.depth(raw)
        if self._flips_rows:
            rgb, raw = rgb[::-1], raw[::-1]
        config = self._config
        depth_m = images.depth_in_metres(raw, config.depth_scale, config.min_depth_m, config.max_depth_m)
        if not depth_m.any():
            raise FrameError(
                f"{pair.depth}: no pixel has a depth from {config.min_depth_m:g} to {config.max_depth_m:g} m; "
                f"if all frames say so, check dataset.depth_scale{other_scale(raw, config.depth_scale)}"
            )
        if self._registration is not None:
            depth_m = self._registration(depth_m)
        return Frame(index, pair.timestamp_s, colour_as_float(rgb), depth_m)

    def groundtruth(self) -> Trajectory | None:
        """Camera-to-world poses from the ground truth file, or None without one. Raises DatasetError."""
        if self._groundtruth is None:
            return None
        return read_groundtruth(self._groundtruth, [pair.timestamp_s for pair in self._pairs])

    def truth(self) -> SceneTruth | None:
        """None: nobody has labelled the surfaces of a recording."""
        return None

    def _check_sizes(self, pair: ImagePair, colour: tuple[int, ...], depth: tuple[int, ...]) -> None:
        if self._registration is None and colour != depth:
            raise FrameError(
                f"{pair.depth}: depth is {depth[1]}x{depth[0]}, but its colour image is {colour[1]}x{colour[0]}; "
                "register depth to colour first"
            )
        expected = (self._camera.height, self._camera.width)
        if colour != expected:
            raise FrameError(f"{pair.colour}: {colour[1]}x{colour[0]}, but the sequence is {expected[1]}x{expected[0]}")
        width, height = self._depth_size
        if depth != (height, width):
            raise FrameError(f"{pair.depth}: {depth[1]}x{depth[0]}, but the sequence's depth is {width}x{height}")


def _image_size(name: str, pairs: list[ImagePair]) -> tuple[int, int]:
    """Width and height of the first colour image that can be read."""
    first_error = ""
    for pair in pairs:
        try:
            height, width = images.read_colour(pair.colour).shape[:2]
        except FrameError as error:
            first_error = first_error or str(error)
        else:
            return width, height
    raise DatasetError(f"{name}: none of its {len(pairs)} colour images can be read; the first: {first_error}")


def _depth_size(pairs: list[ImagePair], colour: tuple[int, int]) -> tuple[int, int]:
    """Width and height of most depth images, by a few of them; those of colour where there is no other."""
    sizes: Counter[tuple[int, int]] = Counter()
    for index in _some(pairs):
        with contextlib.suppress(FrameError):
            height, width = images.read_raw_depth(pairs[index].depth).shape
            sizes[width, height] += 1
    return colour if colour in sizes or not sizes else sizes.most_common(1)[0][0]


def _unused_bits(name: str, pairs: list[ImagePair]) -> int:
    """See `images.unused_bits`; told by a few images of the recording."""
    bits = images.unused_bits([pairs[index].colour for index in _some(pairs)])
    if bits:
        _log.warning("%s: colour uses %d of its 16 bits; it is read as if white were 2^%d", name, 16 - bits, 16 - bits)
    return bits


def _some(pairs: list[ImagePair]) -> range:
    """The numbers of a few, spread evenly."""
    return range(0, len(pairs), max(1, len(pairs) // _SAMPLE_IMAGES))
