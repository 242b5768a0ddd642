"""The log of our programs: one line on stderr for each record, whatever others put into it."""

from __future__ import annotations

import logging
from types import TracebackType

from macs_zenoh.plain import LONGEST, plain, plain_lines

LOG_FORMAT = "%(asctime)s %(levelname).1s %(name)s: %(message)s"


class PlainFormatter(logging.Formatter):
    """One line for each record, without control characters; a traceback's lines are indented, so that none looks like
    a record."""

    def __init__(self, prefix: str = "") -> None:
        super().__init__(prefix + LOG_FORMAT, datefmt="%H:%M:%S")

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        record.message = plain(record.message[:LONGEST])
        return super().formatMessage(record)

    def formatException(  # noqa: N802 - logging's name
        self, ei: tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None]
    ) -> str:
        return "\n".join(f"  {plain_lines(line)}" for line in super().formatException(ei).split("\n"))


def log_to_stderr() -> None:
    """Log to stderr, unless somebody has set that up before; other libraries only from WARNING on."""
    root = logging.getLogger()
    if not root.handlers:
        root.addHandler(logging.StreamHandler())
        prefix_logs("")


def prefix_logs(prefix: str) -> None:
    """Put ``prefix`` before each line of our own log, as before those of other programs on the same terminal."""
    for handler in logging.getLogger().handlers:
        handler.setFormatter(PlainFormatter(prefix))
