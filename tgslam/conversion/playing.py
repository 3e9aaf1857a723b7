"""Any source of RGB-D frames played as a stream of bytes, which `tgslam run --input -` and others take."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import BinaryIO

from tgslam.datasets.live.stream_format import frame_bytes, header_line
from tgslam.datasets.source import RgbdSource
from tgslam.errors import DatasetError, FrameError

_log = logging.getLogger(__name__)


def play(source: RgbdSource, file: BinaryIO, *, live: bool = False, on_frame: Callable[[], None] = lambda: None) -> int:
    """Write every frame that can be read, and return how many these are.

    live: at the pace at which they were taken, and such that who takes them may drop some; else as fast as they are
    taken, and none is dropped. on_frame: called after each frame. Raises DatasetError when no frame is left,
    and OSError.
    """
    file.write(header_line(source.name, source.camera, lossless=not live))
    written, start_s, first_s = 0, time.monotonic(), None
    for position in range(len(source)):
        try:
            frame = source.read(position)
        except FrameError as error:
            _log.warning("frame %d is left out: %s", position, error)
            continue
        finally:
            on_frame()
        first_s = frame.timestamp_s if first_s is None else first_s
        if live:
            time.sleep(max(0.0, start_s + frame.timestamp_s - first_s - time.monotonic()))
        file.write(frame_bytes(frame))
        file.flush()
        written += 1
    if not written:
        raise DatasetError(f"{source.name}: none of its {len(source)} frames could be read; see the warnings")
    return written
