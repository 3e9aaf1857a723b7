"""Seconds of repeated work, by stage, and what is reported of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from tgslam.device import runtime
from tgslam.device.stopwatch import Stopwatch

REST = "rest"  # what the stages leave of the whole


class Samples:
    """Repetitions of one piece of work whose stages a stopwatch times."""

    def __init__(self, stopwatch: Stopwatch) -> None:
        self._stopwatch = stopwatch
        self._total_s: list[float] = []
        self._stage_s: list[dict[str, float]] = []

    def take(self, work: Callable[[], object]) -> None:
        """Do the work once and time it."""
        self._stopwatch.seconds.clear()
        runtime.wait()
        start = time.perf_counter()
        work()
        runtime.wait()
        self.add(time.perf_counter() - start, self._stopwatch.seconds)

    def add(self, total_s: float, stage_s: Mapping[str, float]) -> None:
        """Note work that has been timed already."""
        self._total_s.append(total_s)
        self._stage_s.append(dict(stage_s))

    def clear(self) -> None:
        """Forget all samples, as after warming up."""
        self._total_s.clear()
        self._stage_s.clear()

    def __len__(self) -> int:
        return len(self._total_s)

    def report(self, rest: str = REST) -> dict[str, Any]:
        """`ms` of the whole, `stages_ms`, and each stage's `share` of the whole over all samples.

        rest: the name for what the stages leave of the whole.
        """
        stages = list(dict.fromkeys(name for sample in self._stage_s for name in sample))
        stage_s = {name: [sample.get(name, 0.0) for sample in self._stage_s] for name in stages}
        stage_s[rest] = [
            total - sum(sample.values()) for total, sample in zip(self._total_s, self._stage_s, strict=True)
        ]
        total_s = sum(self._total_s)
        return {
            "ms": summary_ms(self._total_s),
            "stages_ms": {name: summary_ms(values) for name, values in stage_s.items()},
            "share": {name: sum(values) / total_s for name, values in stage_s.items()},
        }


def summary_ms(seconds: Sequence[float]) -> dict[str, float]:
    """Least and median in milliseconds: the least is what the code can do, the median what this machine let it do."""
    return {"min": 1e3 * min(seconds), "median": 1e3 * float(np.median(seconds))}
