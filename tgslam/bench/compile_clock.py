"""Runs tgslam under a clock of kernel compilation, as `python -m cProfile` runs a program under its profiler.

    python -m tgslam.bench.compile_clock RESULT.json ARGUMENTS OF TGSLAM

The clock looks into Taichi 1.7.4, which offers none itself; the version is pinned in pyproject.toml.
"""

from __future__ import annotations

import json
import runpy
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tgslam.device.quick_import import quick_import

with quick_import():
    from taichi._lib import core
    from taichi.lang.kernel_impl import Kernel

STAGES = ("translate", "compile", "load")


class CompileClock:
    """Adds up what each kernel takes until it runs for the first time.

    translate: Python to Taichi's intermediate form, in every process. compile: through LLVM, or out of the cache.
    load: machine code, in every process; the first execution of the kernel counts here too.
    """

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self.kernels: set[int] = set()
        self._is_new = False

    def start(self) -> None:
        """Put the clock into Taichi's way, for the rest of the process."""
        program = core.Program
        translate, compile_kernel, launch = Kernel.materialize, program.compile_kernel, program.launch_kernel

        def timed_compile(program: Any, config: Any, capabilities: Any, kernel: Any) -> Any:
            self._is_new = id(kernel) not in self.kernels  # Taichi keeps its kernels, so an id stays that kernel's
            self.kernels.add(id(kernel))
            return self._timed("compile", compile_kernel, program, config, capabilities, kernel)

        def timed_launch(program: Any, compiled: Any, context: Any) -> None:
            if not self._is_new:
                launch(program, compiled, context)
                return
            self._timed("load", launch, program, compiled, context)

        def timed_translate(kernel: Kernel, *arguments: Any, **named: Any) -> None:
            self._timed("translate", translate, kernel, *arguments, **named)

        Kernel.materialize = timed_translate
        program.compile_kernel, program.launch_kernel = timed_compile, timed_launch

    def _timed(self, stage: str, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        start = time.perf_counter()
        try:
            return function(*arguments, **named)
        finally:
            self.seconds[stage] += time.perf_counter() - start


def main() -> None:
    """Start the clock, run tgslam with the remaining arguments, and write what the clock says at its end."""
    result = Path(sys.argv.pop(1))
    clock = CompileClock()
    clock.start()
    try:
        runpy.run_module("tgslam", run_name="__main__", alter_sys=True)
    finally:
        result.write_text(json.dumps({**clock.seconds, "kernels": len(clock.kernels)}), encoding="utf-8")


if __name__ == "__main__":
    main()
