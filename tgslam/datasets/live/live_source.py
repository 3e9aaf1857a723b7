"""Frames that come while the run goes on. How many there will be is not known, and none can be read again."""

from __future__ import annotations

import dataclasses
import logging
import math
import threading
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from tgslam.camera import Camera
from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets.calibration import resolve
from tgslam.datasets.folder import FolderSource
from tgslam.datasets.live.latest_frames import LatestFrames
from tgslam.datasets.live.sent_frame import Announcement, Feed, SentFrame
from tgslam.datasets.stored import RawDepth, StoredRecording
from tgslam.errors import ConfigError, DatasetError, FrameError
from tgslam.types import Frame, Trajectory

_log = logging.getLogger(__name__)


class LiveSource:
    """Frames from a feed, made what the system takes just as those of a recording are."""

    def __init__(self, feed: Feed, config: DatasetConfig) -> None:
        """Raises ConfigError and DatasetError for a camera or sizes that do not go together."""
        told = feed.announcement
        if config.depth_scale is None and told.depth_units is None and not told.float_depth:
            raise ConfigError(f"{told.name}: the unit of depth is not known; set dataset.depth_scale, units in a metre")
        self.name = told.name
        self._feed = feed
        self._latest = LatestFrames(told.lossless)
        self._at_hand = _FrameAtHand(told)
        calibration = resolve(config, told.calibration, "or let the stream's first line say it")
        recording = StoredRecording(told.name, self._at_hand, calibration, told.depth_units or 1.0)
        self._decoder = FolderSource(recording, config)
        self._failure: Exception | None = None
        self._thread = threading.Thread(target=self._receive, name="live-frames", daemon=True)

    @property
    def camera(self) -> Camera:
        """The pinhole camera of every frame."""
        return self._decoder.camera

    @property
    def dropped(self) -> int:
        """Frames so far that came faster than they were taken."""
        return self._latest.dropped

    def frames(self, stop_requested: Callable[[], bool] = lambda: False) -> Iterator[Frame | FrameError]:
        """Every frame that is not dropped, or why it cannot be used, until the last one or a request to stop; once.

        `Frame.index` counts the frames that come out here. A feed that breaks off ends them with a warning. Raises
        DatasetError where not one frame came.
        """
        self._thread.start()
        position = 0
        try:
            while (sent := self._latest.take(stop_requested)) is not None:
                yield self._decoded(position, sent)
                position += 1
        finally:  # also where the caller leaves off
            self._latest.close()
        if stop_requested():
            return
        if self._failure is not None and not isinstance(self._failure, (DatasetError, OSError)):
            raise self._failure
        reason = "" if self._failure is None else f": {self._failure}"
        if not position:
            raise DatasetError(f"{self.name}: no frame came{reason}")
        if reason:
            _log.warning("%s: ends after %d frames%s", self.name, self._latest.came, reason)

    def groundtruth(self) -> Trajectory | None:
        """None: nobody sends poses."""
        return None

    def close(self) -> None:
        """Receive no more frames, and say how many were dropped."""
        self._latest.close()
        if self._latest.came:
            _log.info("%s: %d frames came, %d of them were dropped", self.name, self._latest.came, self.dropped)

    def _receive(self) -> None:
        """In a thread of its own: frames as they come, so that who sends them never waits for the run."""
        try:
            while (sent := self._feed.next()) is not None and self._latest.put(sent):
                pass
        except Exception as error:  # told by the thread that takes the frames
            self._failure = error
        finally:
            self._latest.end()

    def _decoded(self, position: int, sent: SentFrame) -> Frame | FrameError:
        self._at_hand.sent = sent
        try:
            if not math.isfinite(sent.timestamp_s):
                raise FrameError(f"{self.name}: the time of frame {sent.number} is {sent.timestamp_s}")
            return dataclasses.replace(self._decoder.read(0), index=position, timestamp_s=sent.timestamp_s)
        except FrameError as error:
            return error


class _FrameAtHand:
    """The latest frame as a recording of one; see `StoredFrames`. Before any comes, blank images tell the sizes."""

    times_s: Sequence[float] = (0.0,)

    def __init__(self, told: Announcement) -> None:
        self.sent: SentFrame | None = None
        self._told = told

    def names(self, index: int) -> tuple[str, str]:
        number = 0 if self.sent is None else self.sent.number
        return f"{self._told.name}: colour of frame {number}", f"{self._told.name}: depth of frame {number}"

    def colour(self, index: int) -> NDArray[np.uint8]:
        return np.zeros((*self._told.size[::-1], 3), np.uint8) if self.sent is None else self.sent.colour()

    def depth(self, index: int) -> RawDepth:
        return np.zeros(self._told.depth_size[::-1], np.uint16) if self.sent is None else self.sent.depth()
