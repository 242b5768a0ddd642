"""What a program does with its standard streams, whatever they are: closed, full, a pipe nobody reads, not UTF-8.

Data goes to stdout. When it cannot, a verb that has to say something ends with 1 and one line; one that serves, or
stops robots, goes on. Stderr is for people: what it does not take is lost. What others said is in both, so both are
filtered (`macs_zenoh.plain`); the log is as well (`bridge.logs`).
"""

from __future__ import annotations

import errno
import io
import json
import logging
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from macs_zenoh.plain import plain, plain_json, plain_lines


class OutputLost(Exception):
    """What was to be said on stdout cannot be written. ``reader_left``: as ``head`` does, which is no fault."""

    def __init__(self, error: OSError) -> None:
        super().__init__(f"cannot write its output: {error.strerror or error}")
        self.reader_left = error.errno == errno.EPIPE


class _Output(io.FileIO):
    """A descriptor whose errors cannot be taken for others'."""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            raise OutputLost(error) from None


def prepare() -> None:
    """Have three streams that can be used, and stdout for data only. For a process, at its start.

    A closed descriptor would be given to the next socket, and be written to by whoever logs. What Zenoh logs goes to
    descriptor 1, in the middle of whatever reads our output as JSON: there it is turned to stderr.
    """
    encoding, buffering = _encoding(), sys.stdout is not None and bool(sys.stdout.line_buffering)
    for descriptor, mode in ((0, os.O_RDONLY), (1, os.O_RDONLY), (2, os.O_WRONLY)):  # 1: so that writing is an error
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, mode)  # it gets the lowest that is free
    if sys.stdin is None:
        sys.stdin = open(0, closefd=False)  # noqa: SIM115
    if sys.stderr is None:
        sys.stderr = open(2, "w", errors="backslashreplace", closefd=False)  # noqa: SIM115
    own = os.dup(1)
    os.dup2(2, 1)
    raw = io.BufferedWriter(_Output(own, "w"))
    sys.stdout = io.TextIOWrapper(raw, encoding=encoding, errors="backslashreplace", line_buffering=buffering)
    logging.raiseExceptions = False


def _encoding() -> str:
    return getattr(sys.stdout, "encoding", None) or "utf-8"


def finish() -> None:
    """Write what waits. Raises OutputLost."""
    sys.stdout.flush()


def give_up() -> None:
    """Let nothing be tried again that waits to be written: Python would, at exit, and complain."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def say(text: str, *, coloured: bool = False) -> None:
    """A line or several on stdout, at once, without control characters; ``coloured``: with those of colours, and what
    others said was filtered before. Raises OutputLost."""
    sys.stdout.write((text if coloured else plain_lines(text)) + "\n")
    sys.stdout.flush()


def say_if_possible(text: str) -> None:
    """A line on stdout of a program whose work matters more."""
    try:
        say(text)
    except OutputLost as lost:
        give_up()
        if not lost.reader_left:
            logging.getLogger("macs").warning("this program %s", lost)


def note(text: str) -> None:
    """A line or several on stderr, where that is possible, without control characters."""
    with suppress(OSError, ValueError):
        sys.stderr.write(plain_lines(text) + "\n")
        sys.stderr.flush()


@contextmanager
def status_line() -> Iterator[Callable[[str], None]]:
    """One line on a terminal's stderr that is written over again and again, and gone in the end; elsewhere nothing."""
    if not sys.stderr.isatty():
        yield lambda text: None
        return

    def write(text: str) -> None:
        with suppress(OSError, ValueError):
            sys.stderr.write(f"\r\x1b[K{plain(text)[: shutil.get_terminal_size().columns - 1]}")
            sys.stderr.flush()

    try:
        yield write
    finally:
        write("")


def as_json(value: Any) -> str:
    """One line of JSON in the encoding of stdout, with control characters as JSON writes them."""
    ascii_only = _encoding().lower() not in ("utf-8", "utf8")
    return plain_json(json.dumps(value, ensure_ascii=ascii_only, allow_nan=False))
