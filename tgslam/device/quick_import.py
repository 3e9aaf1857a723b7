"""Importing Taichi 1.7.4, and modules with kernels, in half the time."""

from __future__ import annotations

import inspect
import linecache
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType, ModuleType

_VERSION_CHECK = "taichi._version_check"


@contextmanager
def quick_import() -> Iterator[None]:
    """Inside, imports of Taichi and of kernels leave out what only costs time.

    For every function that `ti.kernel` or `ti.func` decorates, Taichi asks `inspect` for the line that runs around it,
    to see whether that opens a class, and `inspect` goes through all modules that are loaded to find its file. Here it
    takes the line from the frame's file straight away. And Taichi loads an HTTP client, to ask its makers' server for
    newer versions when it starts. Here it doesn't: its version is pinned.
    """
    original = inspect.getframeinfo
    inspect.getframeinfo = _frame_info  # type: ignore[assignment]
    sys.modules.setdefault(_VERSION_CHECK, _no_version_check())
    try:
        yield
    finally:
        inspect.getframeinfo = original


def _frame_info(frame: FrameType) -> inspect.Traceback:
    code, line = frame.f_code, frame.f_lineno
    return inspect.Traceback(code.co_filename, line, code.co_name, [linecache.getline(code.co_filename, line)], 0)


def _no_version_check() -> ModuleType:
    module = ModuleType(_VERSION_CHECK)
    vars(module)["start_version_check_thread"] = lambda: None
    return module
