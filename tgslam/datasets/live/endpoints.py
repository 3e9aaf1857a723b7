"""Where a stream comes from or goes to: standard input and output, or a socket that only this machine reaches."""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import socket
import sys
import urllib.parse
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from tgslam.config.input_settings import DatasetConfig
from tgslam.datasets.live.live_source import LiveSource
from tgslam.datasets.live.sent_frame import Feed
from tgslam.datasets.live.stream_format import StreamReader
from tgslam.errors import ConfigError, DatasetError

_log = logging.getLogger(__name__)
STANDARD = "-"
_TCP, _REALSENSE = "tcp:", "realsense:"


def is_live(text: str) -> bool:
    """Whether what a user gave as input names a live one, and no folder or file."""
    return text == STANDARD or text.startswith((_TCP, _REALSENSE))


@contextlib.contextmanager
def open_live(text: str, config: DatasetConfig) -> Iterator[LiveSource]:
    """The live source that a user names, for as long as the block lasts. Waits until who sends has begun.

    Raises ConfigError for what does not name one, and DatasetError for one that does not come about.
    """
    with contextlib.closing(_open_feed(text)) as feed, contextlib.closing(LiveSource(feed, config)) as source:
        yield source


@contextlib.contextmanager
def open_output(text: str) -> Iterator[BinaryIO]:
    """Where a stream is written: `-`, `tcp://127.0.0.1:PORT`, where someone listens, or a file. Raises DatasetError."""
    if text == STANDARD:
        with _standard_output() as file:
            yield file
    elif text.startswith(_TCP):
        address = loopback(text)
        try:
            connection = socket.create_connection(address)
        except OSError as cause:
            raise DatasetError(f"{text}: nobody listens there ({cause.strerror}); start the run first") from cause
        with connection, connection.makefile("wb") as file:
            yield file
    else:
        with Path(text).open("wb") as file:
            yield file


def loopback(text: str) -> tuple[str, int]:
    """Host and port of tcp://127.0.0.1:PORT. Raises ConfigError for another machine's, as a stream is not encrypted."""
    try:
        parts = urllib.parse.urlsplit(text)
        host, port = parts.hostname or "", parts.port
    except ValueError:
        host, port = "", None
    if not text.startswith("tcp://") or not port or not host or parts.path or parts.query or parts.username:
        raise ConfigError(f"{text}: expected tcp://127.0.0.1:PORT, with a port from 1 to 65535")
    host = "127.0.0.1" if host == "localhost" else host
    try:
        inside = ipaddress.ip_address(host).is_loopback
    except ValueError:
        inside = False
    if not inside:
        raise ConfigError(
            f"{text}: only this machine may send frames: use tcp://127.0.0.1:{port}; from others, a tunnel"
        )
    return host, port


def _open_feed(text: str) -> Feed:
    if text.startswith(_REALSENSE):
        from tgslam.datasets.live.realsense import RealSenseFeed  # which most users do not have

        return RealSenseFeed(text.removeprefix(_REALSENSE))
    return _standard_input() if text == STANDARD else _listen(text)


def _standard_input() -> Feed:
    if sys.stdin is None or sys.stdin.isatty():
        raise ConfigError("--input -: standard input is a terminal; pipe a stream of frames into it")
    # A file of its own, which stays open: a thread that still waits there ends with the process
    file = open(os.dup(sys.stdin.fileno()), "rb", buffering=0)  # noqa: PTH123, SIM115

    def receive(view: memoryview) -> int:
        return file.readinto(view) or 0

    return StreamReader(receive, "standard input")


def _listen(text: str) -> Feed:
    host, port = loopback(text)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.create_server((host, port), family=family, backlog=1) as server:
            _log.info("%s: waits for who sends frames", text)
            connection, _ = server.accept()
    except OSError as cause:
        raise DatasetError(f"{text}: cannot listen there ({cause.strerror or cause}); choose another port") from cause

    def hang_up() -> None:
        with contextlib.suppress(OSError):  # the other side may have gone
            connection.shutdown(socket.SHUT_RDWR)
        connection.close()

    try:
        return StreamReader(connection.recv_into, text, hang_up)
    except BaseException:
        hang_up()
        raise


@contextlib.contextmanager
def _standard_output() -> Iterator[BinaryIO]:
    """Standard output for the stream alone: what else is printed meanwhile goes to standard error."""
    if sys.stdout.isatty():
        raise ConfigError("--output -: standard output is a terminal; pipe it into who takes the stream")
    sys.stdout.flush()
    number = sys.stdout.fileno()
    with open(os.dup(number), "wb") as file:  # noqa: PTH123
        kept = os.dup(number)
        os.dup2(sys.stderr.fileno(), number)
        try:
            yield file
        finally:
            sys.stdout.flush()
            os.dup2(kept, number)
            os.close(kept)
