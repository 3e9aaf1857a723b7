"""Importing kernels, and Taichi itself, without Taichi's search for source lines.

For every function that `ti.kernel` or `ti.func` decorates, Taichi asks `inspect` for the line that runs around it, to
see whether that opens a class, and `inspect` goes through all modules that are loaded to find it: a third of the time
that Taichi takes to import, and most of what the kernels take.
"""

from __future__ import annotations

import inspect
import linecache
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def quick_decorators() -> Iterator[None]:
    """Inside, `inspect.getframeinfo` takes a frame's line from its file straight away."""
    original = inspect.getframeinfo
    inspect.getframeinfo = _frame_info  # type: ignore[assignment]
    try:
        yield
    finally:
        inspect.getframeinfo = original


def _frame_info(frame: FrameType) -> inspect.Traceback:
    code, line = frame.f_code, frame.f_lineno
    return inspect.Traceback(code.co_filename, line, code.co_name, [linecache.getline(code.co_filename, line)], 0)
