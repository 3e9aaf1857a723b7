"""Command line of the CUDA check."""

from __future__ import annotations

import argparse
import contextlib
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tools.cudacheck import budgets, ptxas
from tools.cudacheck.environment import CACHE_VARIABLE, Grid, require_platform
from tools.cudacheck.failures import CudaCheckError
from tools.cudacheck.program import Outcome, run_program

_DESCRIPTION = "Check the CUDA kernels of a Taichi program on a machine that has no GPU."
_EPILOG = f"""\
The program must ask for ti.cuda itself; options go before its name, what follows belongs to it. Its exit status is
passed on; 1 also if it launched no CUDA kernel, if the check reports anything (lines that begin with "cudastub:") or
if a budget is exceeded; 2 if the check cannot be carried out. Built things are kept in ${CACHE_VARIABLE}, by default
in the user's cache folder. Each run is on one core; what takes a GPU milliseconds can take minutes.
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the tool and return its exit status."""
    options = _parser().parse_args(arguments)
    try:
        with _dump_folder(options.dump) as dump:
            require_platform()
            run = run_program(
                options.program,
                options.arguments,
                dump,
                execute=options.command == "execute",
                grid=Grid(getattr(options, "grid", Grid.DEFAULT)),
            )
            problems = run.problems
            if run.status == 0 and options.command == "codegen":
                problems = problems + _check_usage(dump, options.budgets, options.write_budgets)
    except CudaCheckError as error:
        print(f"cudacheck: {error}", file=sys.stderr)
        return 2
    return _verdict(Outcome(run.status, problems))


def _check_usage(dump: Path, budget_file: Path | None, write: bool) -> list[str]:
    """Print what the kernels take; the budgets that they break, or write new ones."""
    rows = ptxas.usage([dump])
    if write:
        path = budget_file or budgets.BUDGETS_FILE
        known = budgets.load_budgets(path) if path.exists() else {}
        budgets.write_budgets(path, known | budgets.with_headroom(rows))
        budget_file = path
    limits = None if budget_file is None else budgets.load_budgets(budget_file)
    print(budgets.table(rows, limits))
    return [] if limits is None else budgets.violations(rows, limits)


def _verdict(outcome: Outcome) -> int:
    """Say in one line what is wrong, and return the exit status."""
    if outcome.status:
        print(f"cudacheck: the program failed with status {outcome.status}", file=sys.stderr)
        return outcome.status
    if outcome.problems:
        more = f" (and {len(outcome.problems) - 1} more)" if len(outcome.problems) > 1 else ""
        print(f"cudacheck: failed: {outcome.problems[0]}{more}", file=sys.stderr)
        return 1
    return 0


@contextlib.contextmanager
def _dump_folder(chosen: Path | None) -> Iterator[Path]:
    if chosen is not None:
        if chosen.exists() and any(chosen.glob("module_*.ptx")):
            raise CudaCheckError(f"{chosen} holds the PTX of an earlier run; name another folder, or remove it first")
        chosen.mkdir(parents=True, exist_ok=True)
        yield chosen.resolve()
    else:
        with tempfile.TemporaryDirectory(prefix="cudacheck-") as folder:
            yield Path(folder)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tools.cudacheck",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="codegen|execute")
    codegen = commands.add_parser(
        "codegen",
        help="generate PTX without running it, assemble it with ptxas, and tell what each kernel takes",
        description=f"Launches do nothing; ptxas then assembles every kernel for {', '.join(ptxas.ARCHITECTURES)}.",
    )
    codegen.add_argument(
        "--budgets", type=Path, metavar="FILE", help="YAML of what each kernel may take; fail above it"
    )
    codegen.add_argument(
        "--write-budgets",
        action="store_true",
        help="write what the launched kernels take, with some room, to FILE (default: the tool's own budgets.yaml)",
    )
    execute = commands.add_parser(
        "execute",
        help="run the program, its CUDA kernels on the CPU",
        description="Run the program's kernels on the CPU.",
    )
    execute.add_argument(
        "--grid",
        choices=[grid.value for grid in Grid],
        default=Grid.DEFAULT.value,
        help="blocks as they come, hardly more than one, or everything backwards; default: %(default)s",
    )
    for command in (codegen, execute):
        command.add_argument("--dump", type=Path, metavar="DIR", help="keep PTX and a log of launches in this folder")
        command.add_argument("program", metavar="MODULE_OR_SCRIPT")
        command.add_argument("arguments", nargs=argparse.REMAINDER, metavar="ARGS")
    return parser


if __name__ == "__main__":
    sys.exit(main())
