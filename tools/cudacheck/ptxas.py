"""What a kernel takes of a GPU, as ptxas tells it: registers, stack, spills, shared memory."""

from __future__ import annotations

import importlib.util
import re
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from tools.cudacheck.environment import require_program
from tools.cudacheck.failures import CudaCheckError

ARCHITECTURES = ("sm_86", "sm_89", "sm_90")
_TASK = re.compile(r"(?P<kernel>.+)_c\d+_\d+(?:_(?:reverse|forward)_grad)?_kernel_\d+_\w+")
_ENTRY = re.compile(r"Compiling entry function '(\S+)'")
_STACK = re.compile(r"(\d+) bytes stack frame, (\d+) bytes spill stores, (\d+) bytes spill loads")
_USED = re.compile(r"Used (\d+) registers")
_SHARED = re.compile(r"(\d+) bytes smem")


@dataclass(frozen=True)
class Usage:
    """What one kernel takes on one architecture, each the most that any of its tasks takes; bytes but for registers."""

    kernel: str
    architecture: str
    registers: int
    shared_bytes: int
    stack_bytes: int
    spill_bytes: int

    def joined(self, other: Usage) -> Usage:
        """The larger of each of two tasks' figures."""
        return Usage(
            self.kernel,
            self.architecture,
            max(self.registers, other.registers),
            max(self.shared_bytes, other.shared_bytes),
            max(self.stack_bytes, other.stack_bytes),
            max(self.spill_bytes, other.spill_bytes),
        )


def kernel_of(entry: str) -> str | None:
    """The Taichi kernel that a PTX entry is a task of; None for the kernels that Taichi brings along.

    >>> kernel_of("adam_rows_c70_1_kernel_0_range_for")
    'adam_rows'
    """
    match = _TASK.fullmatch(entry)
    if match is None or match["kernel"] in _taichi_kernels() or match["kernel"].startswith("snode_"):
        return None
    return match["kernel"]


def usage(folders: Iterable[Path], architectures: Iterable[str] = ARCHITECTURES) -> list[Usage]:
    """Assemble all PTX modules in these folders; one row for each kernel and architecture, in that order.

    Raises MissingToolError without ptxas, CudaCheckError if it refuses a module.
    """
    rows: dict[tuple[str, str], Usage] = {}
    modules = sorted(path for folder in folders for path in folder.glob("module_*.ptx"))
    for architecture in architectures:
        for module in modules:
            if not any(map(kernel_of, re.findall(r"\.entry ([\w$.]+)\(", module.read_text()))):
                continue
            for row in assemble(module, architecture):
                key = row.kernel, architecture
                rows[key] = rows[key].joined(row) if key in rows else row
    return [rows[key] for key in sorted(rows)]


def assemble(module: Path, architecture: str) -> list[Usage]:
    """Each task of our kernels in a PTX file. Raises as `usage` does."""
    command = [require_program("ptxas"), f"-arch={architecture}", "-v", "-O3", str(module), "-o", "/dev/null"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise CudaCheckError(f"ptxas refuses {module} for {architecture}: {done.stderr.strip()}")
    return parse_report(done.stderr, architecture)


def parse_report(text: str, architecture: str) -> list[Usage]:
    """Read what `ptxas -v` prints."""
    rows, kernel, stack, spills = [], None, 0, 0
    for line in text.splitlines():
        if match := _ENTRY.search(line):
            kernel, stack, spills = kernel_of(match[1]), 0, 0
        elif match := _STACK.search(line):
            stack, spills = int(match[1]), int(match[2]) + int(match[3])
        elif (match := _USED.search(line)) and kernel:
            shared = _SHARED.search(line)
            rows.append(Usage(kernel, architecture, int(match[1]), int(shared[1]) if shared else 0, stack, spills))
            kernel = None
    return rows


@cache
def _taichi_kernels() -> frozenset[str]:
    """Names of the kernels in Taichi's own sources, read as text: to import it takes a second and prints a banner."""
    spec = importlib.util.find_spec("taichi")
    if spec is None or not spec.submodule_search_locations:
        return frozenset()
    root = Path(spec.submodule_search_locations[0])
    sources = (root / "_kernels.py", *(root / "algorithms").glob("*.py"))
    return frozenset(name for path in sources for name in re.findall(r"^def (\w+)\(", path.read_text(), re.MULTILINE))
