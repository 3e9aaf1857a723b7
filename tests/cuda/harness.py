"""Run the same code on the CPU device and as CUDA kernels that are executed without a GPU, and compare.

A *scenario* is a function in a module of `tests.cuda.scenarios` that is marked with `@scenario`. It takes nothing, or
keyword arguments that JSON can hold and that have defaults; it returns a dict of NumPy arrays. It builds its inputs
from a fixed seed, uploads them with `runtime.to_device`, calls op wrappers or kernels, and brings the results back with
`runtime.to_host`. Taichi has been started on one device or the other before it is called. Keep it small: thousands of
Gaussians, images of 64x48; the emulation does some 10^8 PTX instructions a second.

    # tests/cuda/scenarios/adam.py
    @scenario
    def steps(rows: int = 300) -> dict[str, np.ndarray]: ...

    # tests/cuda/test_adam.py
    from tests.cuda.harness import GRIDS, Devices, assert_close
    from tests.cuda.scenarios import adam

    pytestmark = pytest.mark.cuda_check

    @pytest.mark.parametrize("grid", GRIDS)
    def test_adam_matches_the_cpu(devices: Devices, grid):
        cpu, cuda = devices.both(adam.steps, grid, rows=40)
        assert_close(cuda, cpu, rtol=1e-5, atol=1e-7)

`devices` (a fixture for the whole session) keeps a process for each of the two devices, and starts a new one for the
next grid mode; tests with a parameter `grid` are ordered by it. Results are kept, as is all that was compiled: in the
cache of `tools.cudacheck`, where the next mode and the next session find it. `devices.cpu(f, **arguments)` and
`devices.cuda(f, grid, **arguments)` give one side; a scenario for CUDA alone is compared with what the test computes.
They raise ScenarioError, with what the process wrote, if the scenario raises, crashes (an LLVM abort, a segmentation
fault) or hangs, or if the check reports anything (a `cudastub:` line). The next scenario gets a new process then, so
one failure hides no other.

All kernels that the scenarios launch are also assembled and held against `tools/cudacheck/budgets.yaml`
(test_budgets.py); after a change: `python -m tests.cuda.harness --write-budgets`.
"""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import selectors
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pytest

from tests.cuda import scenarios
from tools.cudacheck.budgets import BUDGETS_FILE, with_headroom, write_budgets
from tools.cudacheck.environment import Grid, environment, reports
from tools.cudacheck.ptxas import Usage, usage

Results = dict[str, np.ndarray]
Scenario = Callable[..., Results]
_S = TypeVar("_S", bound=Scenario)

GRIDS = [pytest.param(grid, id=grid.value) for grid in Grid]
TIMEOUT_S = 600.0  # far above what any takes: a hang ends, a busy machine does not matter
_MARK = "_is_cuda_scenario"
_OUTPUT = "output.txt"  # what a worker prints


class ScenarioError(AssertionError):
    """A scenario failed in its process; the message holds what the process wrote to stderr."""


def scenario(function: _S) -> _S:
    """Mark a function of `tests.cuda.scenarios` as a scenario."""
    setattr(function, _MARK, True)
    return function


def all_scenarios() -> list[Scenario]:
    """Every scenario there is."""
    modules = [
        importlib.import_module(f"{scenarios.__name__}.{m.name}") for m in pkgutil.iter_modules(scenarios.__path__)
    ]
    return [
        function
        for module in modules
        for function in vars(module).values()
        if getattr(function, _MARK, False) and function.__module__ == module.__name__
    ]


def assert_close(found: Results, expected: Results, *, rtol: float = 0.0, atol: float = 0.0) -> None:
    """Both hold the same arrays, of the same shapes and types, with values that agree; NaN equals NaN."""
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        assert (found[name].shape, found[name].dtype) == (array.shape, array.dtype), name
        np.testing.assert_allclose(found[name], array, rtol=rtol, atol=atol, err_msg=name)


class Devices:
    """Processes in which scenarios run: one on the CPU, one with emulated CUDA kernels, started when first needed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._cpu: _Worker | None = None
        self._cuda: _Worker | None = None
        self._results: dict[tuple[Grid | None, str], Results | ScenarioError] = {}

    def cpu(self, function: Scenario, **arguments: Any) -> Results:
        """What a scenario gives on the CPU device."""
        return self._run(None, function, arguments)

    def cuda(self, function: Scenario, grid: Grid = Grid.DEFAULT, **arguments: Any) -> Results:
        """What a scenario gives as CUDA kernels; raises ScenarioError also for whatever the check reports."""
        return self._run(grid, function, arguments)

    def both(self, function: Scenario, grid: Grid = Grid.DEFAULT, **arguments: Any) -> tuple[Results, Results]:
        """What a scenario gives on the CPU device and as CUDA kernels."""
        return self.cpu(function, **arguments), self.cuda(function, grid, **arguments)

    def usage(self) -> list[Usage]:
        """What all kernels of all scenarios take of a GPU. Raises MissingToolError without ptxas."""
        for function in all_scenarios():
            self.cuda(function)
        return usage(self._folder.glob(f"{Grid.DEFAULT.value}-*"))

    def close(self) -> None:
        """End all processes."""
        for worker in (self._cpu, self._cuda):
            if worker:
                worker.close()

    def _run(self, grid: Grid | None, function: Scenario, arguments: dict[str, Any]) -> Results:
        request = json.dumps([function.__module__, function.__name__, arguments], sort_keys=True)
        key = (grid, request)
        if key not in self._results:
            try:
                self._results[key] = self._worker(grid).run(request)
            except ScenarioError as error:
                self._results[key] = error
        result = self._results[key]
        if isinstance(result, ScenarioError):
            raise ScenarioError(str(result))
        return result

    def _worker(self, grid: Grid | None) -> _Worker:
        """The process of that device, in that grid mode: there is one at a time."""
        worker = self._cpu if grid is None else self._cuda
        if worker is None or not worker.usable or worker.grid is not grid:
            if worker:
                worker.close()
            worker = _Worker(self._new_folder(grid), grid)
            if grid is None:
                self._cpu = worker
            else:
                self._cuda = worker
        return worker

    def _new_folder(self, grid: Grid | None) -> Path:
        name = "cpu" if grid is None else grid.value
        folder = self._folder / f"{name}-{len(list(self._folder.glob(f'{name}-*')))}"
        folder.mkdir()
        return folder


class _Worker:
    """A process that runs scenarios one after another until one goes wrong."""

    def __init__(self, folder: Path, grid: Grid | None) -> None:
        self.grid, self.usable = grid, True
        self._folder, self._count = folder, 0
        added = {} if grid is None else environment(folder, execute=True, grid=grid)
        self._answers, descriptor = os.pipe()
        with (folder / _OUTPUT).open("wb") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.cuda.worker", "cpu" if grid is None else "cuda", str(descriptor)],
                cwd=Path(__file__).parents[2], env={**os.environ, **added}, pass_fds=[descriptor],
                stdin=subprocess.PIPE, stdout=output, stderr=output,
            )  # fmt: skip
        os.close(descriptor)

    def run(self, request: str) -> Results:
        """The results of one scenario; after a ScenarioError the worker is of no more use."""
        output = self._folder / f"{self._count}.npz"
        self._count += 1
        before = (self._folder / _OUTPUT).stat().st_size
        answer = self._ask(f"{output}\t{request}\n")
        printed = (self._folder / _OUTPUT).read_bytes()[before:].decode(errors="replace")
        if answer == "done" and not reports(printed):
            with np.load(output) as arrays:
                return dict(arrays)
        self.close()
        raise ScenarioError(f"{request}: {answer}\n{printed}")

    def close(self) -> None:
        """End the process."""
        if not self.usable:
            return
        self.usable = False
        if self._process.stdin:
            self._process.stdin.close()
        try:
            self._process.wait(timeout=60)  # it writes what Taichi has compiled to its cache
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._answers)

    def _ask(self, line: str) -> str:
        """The worker's answer, or how it ended without one."""
        assert self._process.stdin
        try:
            self._process.stdin.write(line.encode())
            self._process.stdin.flush()
        except BrokenPipeError:
            pass  # it ended: said below
        deadline, answer = time.monotonic() + TIMEOUT_S, b""
        with selectors.DefaultSelector() as selector:
            selector.register(self._answers, selectors.EVENT_READ)
            while not answer.endswith(b"\n"):
                if not selector.select(max(0.0, deadline - time.monotonic())):
                    self._process.kill()
                    return f"no answer after {TIMEOUT_S:.0f} s"
                chunk = os.read(self._answers, 4096)
                if not chunk:
                    return f"the process ended with status {self._process.wait()}"
                answer += chunk
        return answer.decode().strip()


def main(arguments: list[str]) -> int:
    """Write the budgets of all kernels that the scenarios launch."""
    if arguments != ["--write-budgets"]:
        print("usage: python -m tests.cuda.harness --write-budgets", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        devices = Devices(Path(folder))
        try:
            write_budgets(BUDGETS_FILE, with_headroom(devices.usage()))
        finally:
            devices.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
