"""How far a run is: a bar in a terminal, a log line now and then elsewhere, nothing when asked to be quiet."""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tgslam.types import FrameReport

_log = logging.getLogger(__name__)
_LINE_INTERVAL_S = 10.0
_LINE_FRACTION = 0.1


class FrameObserver(Protocol):
    """Told about every frame as soon as it is done."""

    def __call__(self, report: FrameReport) -> None:
        """Take note of one frame."""


class _Counts:
    """Frames, keyframes and Gaussians so far, and the frames per second."""

    def __init__(self, total: int | None) -> None:
        self.total, self.frames, self.keyframes, self.gaussians = total, 0, 0, 0
        self._start_s = time.monotonic()

    def add(self, report: FrameReport) -> None:
        self.frames += 1
        self.keyframes += report.is_keyframe
        self.gaussians = max(report.gaussians, 0) or self.gaussians

    @property
    def fps(self) -> float:
        return self.frames / max(time.monotonic() - self._start_s, 1e-9)

    def __str__(self) -> str:
        return f"{self.fps:.1f} frames/s, {self.keyframes} keyframes, {self.gaussians:,} Gaussians"


@contextmanager
def frame_progress(total: int | None, console: Console, quiet: bool) -> Iterator[FrameObserver]:
    """An observer of the `total` frames to come, None = not known, for as long as the block lasts."""
    if quiet:
        yield lambda report: None
    elif console.is_terminal:
        with _bar(console) as bar:
            yield _BarObserver(bar, total)
    else:
        yield _LineObserver(total)


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("frames"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[counts]}"),
        console=console,
    )


class _BarObserver:
    def __init__(self, bar: Progress, total: int | None) -> None:
        self._bar, self._counts = bar, _Counts(total)
        self._task = bar.add_task("frames", total=total, counts="")

    def __call__(self, report: FrameReport) -> None:
        self._counts.add(report)
        self._bar.update(self._task, advance=1, counts=str(self._counts))


class _Pace:
    """A line after every tenth of the work or ten seconds, whichever comes later; and one at the end.

    Where the total is not known, every ten seconds.
    """

    def __init__(self, total: int | None) -> None:
        self._total = total
        self._take_note(0)

    def due(self, done: int) -> bool:
        """Whether so much done is worth a line now."""
        late = done >= self._next and time.monotonic() >= self._next_s
        if late:
            self._take_note(done)
        return late or done == self._total

    def _take_note(self, done: int) -> None:
        self._next = done + _LINE_FRACTION * (self._total or 0)
        self._next_s = time.monotonic() + _LINE_INTERVAL_S


class _LineObserver:
    def __init__(self, total: int | None) -> None:
        self._counts, self._pace = _Counts(total), _Pace(total)

    def __call__(self, report: FrameReport) -> None:
        self._counts.add(report)
        if self._pace.due(self._counts.frames):
            of_all = "" if self._counts.total is None else f" of {self._counts.total}"
            _log.info("frame %d%s: %s", self._counts.frames, of_all, self._counts)


@contextmanager
def step_progress(what: str, total: int, console: Console, quiet: bool) -> Iterator[Callable[[str], None]]:
    """A function to call with the name of each of the `total` steps as it begins, for as long as the block lasts."""
    if quiet:
        yield lambda name: None
    elif console.is_terminal:
        columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"))
        with Progress(*columns, console=console) as bar:
            task = bar.add_task("", total=total, completed=-1)
            yield lambda name: bar.update(task, advance=1, description=name)
    else:
        steps = itertools.count(1)
        yield lambda name: _log.info("%s %d of %d: %s", what, next(steps), total, name)


@contextmanager
def count_progress(what: str, total: int, console: Console, quiet: bool) -> Iterator[Callable[[], None]]:
    """A function to call after each of `total` things of a kind, for as long as the block lasts."""
    if quiet:
        yield lambda: None
    elif console.is_terminal:
        columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console) as bar:
            task = bar.add_task("", total=total)
            yield lambda: bar.update(task, advance=1)
    else:
        pace, counts = _Pace(total), itertools.count(1)

        def count() -> None:
            done = next(counts)
            if pace.due(done):
                _log.info("%s: %d of %d", what, done, total)

        yield count
