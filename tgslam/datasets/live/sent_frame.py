"""What comes from outside while a run goes on: a frame, and who gives the next one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tgslam.datasets.calibration import Calibration
from tgslam.datasets.stored import RawDepth


@dataclass(frozen=True)
class SentFrame:
    """A frame as it came; its images are decoded only when they are asked for."""

    number: int  # from 0, of all that came
    timestamp_s: float
    colour: Callable[[], NDArray[np.uint8]]  # [H, W, 3] RGB; raises FrameError
    depth: Callable[[], RawDepth]  # raises FrameError


@dataclass(frozen=True)
class Announcement:
    """What is known before the first frame comes."""

    name: str  # short, for titles and file names
    size: tuple[int, int]  # width, height of colour, px
    depth_size: tuple[int, int]  # of depth
    calibration: Calibration | None  # of colour; None = the settings must say it
    depth_units: float | None  # of whole-number depth, in a metre; None = the settings must say it
    float_depth: bool = False  # depth comes in metres
    lossless: bool = False  # no frame is dropped: who sends waits


class Feed(Protocol):
    """Where frames come from."""

    @property
    def announcement(self) -> Announcement:
        """What is known of all of them."""

    def next(self) -> SentFrame | None:
        """Wait for the next frame; None after the last one. Raises DatasetError when no more can come, and OSError."""

    def close(self) -> None:
        """No frame is wanted any more: a `next` that waits in another thread may end."""
