"""The command line `tgslam`, the same as `python -m tgslam`. One module a command; `main` makes errors exit codes."""

from __future__ import annotations

import argparse
import logging
import os
import sys
import traceback
from collections.abc import Sequence

from tgslam import __version__
from tgslam.cli import batch_runs as batch
from tgslam.cli import benchmark as bench
from tgslam.cli import convert_recording as convert
from tgslam.cli import doctor, evaluate, render, run
from tgslam.cli import export_run as export
from tgslam.cli import probe_recording as probe
from tgslam.cli.options import add_log_options
from tgslam.errors import TgslamError
from tgslam.output.console import error_console, set_up_logging

EXIT_FAILURE = 1
EXIT_BUG = 70
EXIT_INTERRUPTED = 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code: 0 only if it did what it was asked.

    Raises SystemExit, as argparse does, for --help (0) and for arguments that do not parse (2).
    """
    args = _parser().parse_args(argv)
    level = logging.DEBUG if args.debug else logging.WARNING if args.quiet else logging.INFO
    set_up_logging(error_console(), level)
    try:
        code: int = args.execute(args)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        return _fail("interrupted", EXIT_INTERRUPTED, args.debug)
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115  the reader went away: be silent
        return EXIT_FAILURE
    except TgslamError as error:
        return _fail(str(error), error.exit_code, args.debug)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _fail(f"{where}{error.strerror or error}", EXIT_FAILURE, args.debug)
    except MemoryError:
        return _fail("out of memory; use fewer frames or smaller images", EXIT_FAILURE, args.debug)
    except Exception as error:  # the last resort of the whole program: never a traceback unless it is asked for
        advice = "" if args.debug else "; run it again with --debug for the traceback"
        return _fail(f"this is a bug in tgslam: {type(error).__name__}: {error}{advice}", EXIT_BUG, args.debug)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="tgslam", description="Gaussian splatting SLAM for RGB-D video: camera trajectory and 3D Gaussian map."
    )
    parser.add_argument("--version", action="version", version=f"tgslam {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for module in (run, evaluate, render, export, probe, convert, batch, bench, doctor):
        command = module.add_parser(commands)
        add_log_options(command)
        command.set_defaults(execute=module.execute)
    return parser


def _fail(message: str, code: int, debug: bool) -> int:
    if debug:
        traceback.print_exc()
    print(f"tgslam: error: {' '.join(message.split())}", file=sys.stderr)
    return code
