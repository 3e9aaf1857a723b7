"""Options, and types of their values, that several commands share."""

from __future__ import annotations

import argparse
from typing import Any

_LEAST_PX, _MOST_PX = 16, 8192


def add_log_options(parser: argparse.ArgumentParser, default: Any = False) -> None:
    """`--debug` and `--quiet`. default: argparse.SUPPRESS below a parser that has them too, to keep what it read."""
    parser.add_argument("--debug", action="store_true", default=default, help="show tracebacks and debugging log lines")
    parser.add_argument(
        "--quiet", action="store_true", default=default, help="no progress, and log lines for warnings only"
    )


def add_thread_count(parser: argparse.ArgumentParser) -> None:
    """`--threads` of a benchmark."""
    parser.add_argument("--threads", type=positive, metavar="N", help="CPU threads (default: all cores)")


def size(text: str) -> tuple[int, int]:
    """Width and height of an image, px, from WIDTHxHEIGHT. Raises ArgumentTypeError."""
    width, _, height = text.partition("x")
    if not all(side.isdecimal() and _LEAST_PX <= int(side) <= _MOST_PX for side in (width, height)):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT with sides of {_LEAST_PX} to {_MOST_PX} px")
    return int(width), int(height)


def natural(text: str) -> int:
    """A whole number of 0 or more. Raises ArgumentTypeError."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 0 or more")
    return int(text)


def positive(text: str) -> int:
    """A whole number of 1 or more. Raises ArgumentTypeError."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 1 or more")
    return int(text)
