"""Frames between the thread that receives them and the run: a few at most, of which the latest count."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from tgslam.datasets.live.sent_frame import SentFrame

KEPT = 2  # frames that may wait
_ASK_S = 0.1  # how often a wait asks whether the user wants to stop


class LatestFrames:
    """Holds `KEPT` frames. One more drops the oldest, or waits for room where no frame may be lost."""

    def __init__(self, lossless: bool) -> None:
        self.came = 0
        self.dropped = 0
        self._lossless = lossless
        self._frames: deque[SentFrame] = deque()
        self._ended = False  # nothing comes any more
        self._closed = False  # nothing is wanted any more
        self._changed = threading.Condition()

    def put(self, frame: SentFrame) -> bool:
        """Add a frame; False: none is wanted any more."""
        with self._changed:
            while self._lossless and len(self._frames) >= KEPT and not self._closed:
                self._changed.wait()
            if self._closed:
                return False
            self.came += 1
            if len(self._frames) >= KEPT:
                self._frames.popleft()
                self.dropped += 1
            self._frames.append(frame)
            self._changed.notify_all()
            return True

    def take(self, stop_requested: Callable[[], bool]) -> SentFrame | None:
        """The oldest frame that is held, as soon as there is one; None after the last one, or on a request to stop."""
        with self._changed:
            while not self._frames and not self._ended and not stop_requested():
                self._changed.wait(_ASK_S)
            if not self._frames or stop_requested():
                return None
            self._changed.notify_all()
            return self._frames.popleft()

    def end(self) -> None:
        """No frame comes any more."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def close(self) -> None:
        """No frame is wanted any more; those that wait are forgotten."""
        with self._changed:
            self._closed = self._ended = True
            self._frames.clear()
            self._changed.notify_all()
