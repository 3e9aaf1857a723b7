"""Frames of a source in a given order, decoded by another thread while the caller works on those before."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

from tgslam.datasets.source import RgbdSource
from tgslam.errors import FrameError
from tgslam.types import Frame


def read_frames(
    source: RgbdSource, ahead: bool, positions: Sequence[int] | None = None
) -> Iterator[Frame | FrameError]:
    """The frames at these positions, by default every one in order, or why one cannot be used.

    ahead: one thread reads the next frame meanwhile; only for a source that does not use the kernels itself.
    """
    positions = range(len(source)) if positions is None else positions
    if not ahead:
        for position in positions:
            yield _read(source, position)
        return
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="read-ahead") as pool:
        upcoming = [pool.submit(_read, source, position) for position in positions[:1]]
        for position in positions[1:]:
            current = upcoming.pop().result()
            upcoming.append(pool.submit(_read, source, position))
            yield current
        for last in upcoming:
            yield last.result()


def _read(source: RgbdSource, position: int) -> Frame | FrameError:
    try:
        return source.read(position)
    except FrameError as error:
        return error
