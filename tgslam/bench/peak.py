"""The machine's own multiply-add throughput, in the process and with the threads that the benchmark has."""

from __future__ import annotations

import time

import numpy as np

from tgslam import runtime
from tgslam.kernels import peak

_PARTS_PER_THREAD = 4
_LAUNCH_S = 0.01  # long enough that starting the threads does not show, short enough to be left alone now and then
_LAUNCHES = 20


def multiply_add_gflops(threads: int) -> float:
    """10^9 additions and multiplications a second, the best of several launches.

    It is what Taichi gets out of this machine with everything in registers, not what the data sheet promises.
    """
    x = runtime.zeros((_PARTS_PER_THREAD * threads, peak.CHAINS, peak.LANES), lanes=True)
    _launch_s(x, 1)  # compiles
    steps = 1000
    while _launch_s(x, steps) < _LAUNCH_S:
        steps *= 2
    best_s = min(_launch_s(x, steps) for _ in range(_LAUNCHES))
    return peak.FLOPS_PER_STEP * steps * x.shape[0] / best_s / 1e9


def _launch_s(x: np.ndarray, steps: int) -> float:
    start = time.perf_counter()
    peak.multiply_add(steps, 0.5, 0.25, x)
    runtime.wait()
    return time.perf_counter() - start
