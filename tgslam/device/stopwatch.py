"""Seconds by stage, for logs and benchmarks."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

from tgslam.device import runtime


class Stopwatch:
    """Adds up the wall time of named stages; where stages nest, the outer one counts the inner one too."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a block; what it launched on the device counts to it."""
        runtime.wait()
        start = time.perf_counter()
        try:
            yield
        finally:
            runtime.wait()
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def stage(stopwatch: Stopwatch | None, name: str) -> AbstractContextManager[None]:
    """`stopwatch.stage(name)`, or nothing without a stopwatch: unmeasured work never waits for the device."""
    return stopwatch.stage(name) if stopwatch else nullcontext()
