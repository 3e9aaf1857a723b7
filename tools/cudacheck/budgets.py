"""Budgets: what each kernel may take of a GPU, in a file that is reviewed like code."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import yaml

from tools.cudacheck.failures import CudaCheckError
from tools.cudacheck.ptxas import Usage

BUDGETS_FILE = Path(__file__).parent / "budgets.yaml"
_REGISTER_UNIT = 8  # a GPU hands out registers in such units: less saves nothing
_HEADROOM = 4  # registers that another version of ptxas may take
_MOST_REGISTERS = 255
_UNITS = {
    "registers": "registers",
    "shared_bytes": "bytes of shared memory",
    "stack_bytes": "bytes of stack",
}
_HEADER = """\
# What each kernel may take on any of sm_86, sm_89 and sm_90, the most of its tasks; no kernel may spill.
# stack_bytes is 0 where it is not given. Written by `--write-budgets`, which leaves a few registers of room.
"""


@dataclass(frozen=True)
class Budget:
    """Upper bounds for one kernel."""

    registers: int
    shared_bytes: int
    stack_bytes: int = 0


Budgets = dict[str, Budget]


def load_budgets(path: Path) -> Budgets:
    """Read a budget file. Raises CudaCheckError where it is missing or holds anything else."""
    try:
        content = yaml.safe_load(path.read_text())
        return {kernel: Budget(**limits) for kernel, limits in (content or {}).items()}
    except (OSError, yaml.YAMLError, TypeError, AttributeError) as error:
        raise CudaCheckError(f"{path} is no budget file: {error}") from error


def with_headroom(rows: Iterable[Usage]) -> Budgets:
    """Budgets that these kernels keep to, on every architecture."""
    budgets: Budgets = {}
    for row in rows:
        units = -(-(row.registers + _HEADROOM) // _REGISTER_UNIT)
        registers = min(units * _REGISTER_UNIT, _MOST_REGISTERS)
        so_far = budgets.get(row.kernel, Budget(0, 0))
        budgets[row.kernel] = Budget(
            max(so_far.registers, registers),
            max(so_far.shared_bytes, row.shared_bytes),
            max(so_far.stack_bytes, row.stack_bytes),
        )
    return budgets


def write_budgets(path: Path, budgets: Budgets) -> None:
    """Write a budget file, a line for each kernel, in alphabetic order."""
    lines = []
    for kernel, budget in sorted(budgets.items()):
        stack = f", stack_bytes: {budget.stack_bytes}" if budget.stack_bytes else ""
        lines.append(f"{kernel}: {{registers: {budget.registers}, shared_bytes: {budget.shared_bytes}{stack}}}\n")
    path.write_text(_HEADER + "".join(lines))


def violations(rows: Iterable[Usage], budgets: Budgets) -> list[str]:
    """What breaks a budget, a line each: a figure above it, a spill, a kernel that has none."""
    found = []
    for row in rows:
        where, budget = f"{row.kernel} on {row.architecture}", budgets.get(row.kernel)
        if row.spill_bytes:
            found.append(f"{where}: {row.spill_bytes} bytes of spills")
        if budget is None:
            found.append(f"{where}: no budget")
            continue
        for name, unit in _UNITS.items():
            used, allowed = getattr(row, name), getattr(budget, name)
            if used > allowed:
                found.append(f"{where}: {used} {unit}, budget {allowed}")
    return found


def table(rows: Iterable[Usage], budgets: Budgets | None = None) -> str:
    """The rows as text; with budgets, the allowed figure follows each."""
    heads = ("kernel", "arch", "registers", "shared", "stack", "spills")
    cells: list[tuple[str, ...]] = [heads]
    for row in rows:
        budget = (budgets or {}).get(row.kernel)
        limits = (budget.registers, budget.shared_bytes, budget.stack_bytes) if budget else (None,) * 3
        used = (row.registers, row.shared_bytes, row.stack_bytes)
        figures = [str(n) if limit is None else f"{n}/{limit}" for n, limit in zip(used, limits, strict=True)]
        cells.append((row.kernel, row.architecture, *figures, str(row.spill_bytes)))
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(_aligned(line, widths) for line in cells)


def _aligned(line: tuple[str, ...], widths: list[int]) -> str:
    """Names to the left, figures to the right."""
    names, figures = line[:2], line[2:]
    left = [cell.ljust(width) for cell, width in zip(names, widths[:2], strict=True)]
    return "  ".join(left + [cell.rjust(width) for cell, width in zip(figures, widths[2:], strict=True)])
