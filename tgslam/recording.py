"""A recording as Python programs read it: frames one by one, and the camera that took them."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator
from pathlib import Path

from tgslam.camera import Camera
from tgslam.config.schema import Config
from tgslam.datasets import FrameRange, RgbdSource, open_source, parse_frame_slice
from tgslam.datasets.detection import told_format
from tgslam.errors import FrameError
from tgslam.types import Frame, Trajectory

_log = logging.getLogger(__name__)


class Recording:
    """Frames in order of time. They are read when they are asked for, and none is kept."""

    def __init__(self, source: RgbdSource) -> None:
        self._source = source

    @property
    def name(self) -> str:
        """Short, for titles and file names."""
        return self._source.name

    @property
    def camera(self) -> Camera:
        """The pinhole camera of every frame."""
        return self._source.camera

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, number: int) -> Frame:
        """A frame, from 0 on. Raises FrameError for one that cannot be read, and IndexError beyond the last one."""
        if not 0 <= number < len(self):
            raise IndexError(f"{self.name} has frames 0 to {len(self) - 1}, not {number}")
        return self._source.read(number)

    def __iter__(self) -> Iterator[Frame]:
        """Every frame that can be read; the log names the others, as `tgslam run` does."""
        for number in range(len(self)):
            try:
                yield self._source.read(number)
            except FrameError as error:
                _log.warning("frame %d is skipped: %s", number, error)

    def groundtruth(self) -> Trajectory | None:
        """True camera-to-world poses, where there are any. Raises DatasetError when they cannot be read."""
        return self._source.groundtruth()


def open_recording(
    folder: str | Path | None = None,
    config: Config | None = None,
    *,
    format: str | None = None,
    frames: str | None = None,
) -> Recording:
    """Open a recording, a folder or a file; None = the built-in room, or the scene that the config names.

    config: whose sections `dataset` (format, camera, depth scale) and `synthetic` count here. format: as
    `dataset.format`, by default told from the folder's files. frames: "START:STOP:STEP", every part optional.
    Raises DatasetError and ConfigError for what cannot be opened.
    """
    config = config or Config()
    path = None if folder is None else Path(folder)
    dataset = config.dataset if format is None else dataclasses.replace(config.dataset, format=format)
    source = open_source(told_format(dataset, path), config.synthetic, config.seed, path)
    if frames is not None:
        chosen = parse_frame_slice(frames)
        source = FrameRange(source, chosen.start, chosen.stop, chosen.step)
    return Recording(source)
