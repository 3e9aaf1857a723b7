"""Options that several commands share."""

from __future__ import annotations

import argparse
from typing import Any


def add_log_options(parser: argparse.ArgumentParser, default: Any = False) -> None:
    """`--debug` and `--quiet`. default: argparse.SUPPRESS below a parser that has them too, to keep what it read."""
    parser.add_argument("--debug", action="store_true", default=default, help="show tracebacks and debugging log lines")
    parser.add_argument(
        "--quiet", action="store_true", default=default, help="no progress, and log lines for warnings only"
    )
