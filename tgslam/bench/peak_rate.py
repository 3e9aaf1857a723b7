"""The machine's own multiply-add throughput, in the process and with the threads that the benchmark has."""

from __future__ import annotations

import time

from tgslam.device import runtime
from tgslam.kernels import peak

_PARTS_PER_THREAD = 4
_LAUNCH_S = 0.01  # long enough that starting the threads does not show, short enough to be left alone now and then


class MultiplyAdd:
    """Samples of the throughput, to be taken between those of the work that is compared with it.

    The most counts. It is what Taichi gets out of this machine with everything in registers, not what the data sheet
    promises.
    """

    def __init__(self, threads: int) -> None:
        """threads: that the kernels run on."""
        self.gflops = 0.0  # 10^9 additions and multiplications a second
        self._x = runtime.zeros((_PARTS_PER_THREAD * threads, max(peak.CHAINS), peak.LANES), lanes=True)
        self._steps = 1
        for chains in peak.CHAINS:
            self._launch_s(chains)  # compiles
        while self._launch_s(peak.CHAINS[0]) < _LAUNCH_S:
            self._steps *= 2

    def sample(self) -> None:
        """Measure once more."""
        for chains in peak.CHAINS:
            flops = peak.flops_per_step(chains) * self._steps * self._x.shape[0]
            self.gflops = max(self.gflops, flops / self._launch_s(chains) / 1e9)

    def _launch_s(self, chains: int) -> float:
        start = time.perf_counter()
        peak.multiply_add(self._steps, 0.5, 0.25, chains, self._x)
        runtime.wait()
        return time.perf_counter() - start
