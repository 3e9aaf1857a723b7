"""What the user sees: log lines and progress on stderr, tables on stdout; plain text where there is no terminal."""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.table import Table

PACKAGE_LOGGER = "tgslam"


class _ConsoleHandler(logging.Handler):
    """Log lines through the console that also draws the progress bar, so that neither spoils the other."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        self._console.print(self.format(record), markup=False, highlight=False, soft_wrap=True)


def error_console() -> Console:
    """A console on the current stderr."""
    return Console(stderr=True)


def set_up_logging(console: Console, level: int) -> None:
    """Send the package's log lines to `console`, once, from `level` up."""
    handler = _ConsoleHandler(console)
    handler.setFormatter(logging.Formatter("tgslam: %(message)s"))
    logger = logging.getLogger(PACKAGE_LOGGER)
    logger.handlers[:] = [handler]
    logger.setLevel(level)
    logger.propagate = False


def print_table(title: str, rows: Mapping[str, str] | Sequence[tuple[str, str]]) -> None:
    """Names and values to stdout: a table in a terminal, else `name  value` lines."""
    pairs = list(rows.items()) if isinstance(rows, Mapping) else list(rows)
    if sys.stdout.isatty():
        table = Table(title=title, title_justify="left", show_header=False)
        table.add_column()
        table.add_column(justify="right")
        for name, value in pairs:
            table.add_row(name, value)
        Console().print(table, markup=False)
        return
    width = max((len(name) for name, _ in pairs), default=0)
    print(title)
    for name, value in pairs:
        print(f"  {name:<{width}}  {value}")


def print_columns(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A table of several columns to stdout, numbers to the right: drawn in a terminal, else aligned with spaces."""
    if sys.stdout.isatty():
        table = Table(title=title, title_justify="left")
        for number, name in enumerate(header):
            table.add_column(name, justify="right" if number else "left")
        for row in rows:
            table.add_row(*row)
        Console().print(table, markup=False)
        return
    widths = [max(len(cell) for cell in column) for column in zip(header, *rows, strict=True)]
    print(title)
    for row in (header, *rows):
        cells = [
            cell.rjust(width) if n else cell.ljust(width)
            for n, (cell, width) in enumerate(zip(row, widths, strict=True))
        ]
        print("  " + "  ".join(cells).rstrip())
