"""Ctrl-C and SIGTERM: the first asks the run to end after the current frame, the second ends the process at once."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType, TracebackType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_NOTICE = b"\ntgslam: stopping after this frame and saving what is there; once more to quit at once\n"


class StopRequest:
    """While its `with` block lasts, calling it tells whether the user asked to stop."""

    def __init__(self) -> None:
        self._requested = False
        self._previous: dict[signal.Signals, object] = {}

    def __call__(self) -> bool:
        """Whether a signal has come."""
        return self._requested

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():  # elsewhere Python allows no handlers
            self._previous = {number: signal.signal(number, self._request) for number in _SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _request(self, number: int, frame: FrameType | None) -> None:
        self._requested = True
        for handled in _SIGNALS:
            signal.signal(handled, signal.SIG_DFL)
        os.write(2, _NOTICE)
