"""Running a program against the stub driver."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tools.cudacheck.environment import Grid, environment, launched_kernels, reports


@dataclass(frozen=True)
class Outcome:
    """How a program ended and what the check has to say about it."""

    status: int  # as a shell has it: 128 + the signal that ended it
    problems: list[str]


def run_program(program: str, arguments: list[str], dump: Path, *, execute: bool, grid: Grid = Grid.DEFAULT) -> Outcome:
    """Run a Python file, or a module as `python -m` does, with the stub driver for a GPU; its output is passed on.

    dump: an existing folder for PTX and launch log. Raises CudaCheckError if the driver cannot be built.
    """
    target = [program] if Path(program).is_file() else ["-m", program]
    process = subprocess.Popen(
        [sys.executable, *target, *arguments],
        env={**os.environ, **environment(dump, execute=execute, grid=grid)},
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
    )
    problems = []
    assert process.stderr
    for line in process.stderr:
        sys.stderr.write(line)
        problems += reports(line)
    status = process.wait()
    if status == 0 and not launched_kernels(dump):
        problems.append("no CUDA kernel was launched: Taichi fell back to the CPU, or the program runs no kernels")
    return Outcome(status if status >= 0 else 128 - status, problems)
