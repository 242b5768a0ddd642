"""The log of our programs: one line on stderr for each record, whatever others put into it.

A terminal that was stopped with Ctrl-S, or a pipe that nobody reads, holds up whoever writes to it. What logs may be
in the middle of stopping a robot, so a thread writes that does nothing else.
"""

from __future__ import annotations

import json
import logging
import os
import select
import sys
import threading
import time
from contextlib import suppress
from datetime import datetime, timezone
from queue import Empty, SimpleQueue
from types import TracebackType
from typing import TextIO

from macs_zenoh.plain import LONGEST, plain, plain_json, plain_lines

LOG_FORMAT = "%(asctime)s %(levelname).1s %(name)s: %(message)s"
TIME, DATE = "%H:%M:%S", "%Y-%m-%dT%H:%M:%S%z"
"""On a terminal, and where a log is kept."""

FORMAT = "MACS_LOG_FORMAT"
"""Environment variable for programs that were told no ``--log-format``."""
TEXT, JSON, SHORT = "text", "json", "short"
"""Lines for people; one JSON object in each; lines for people without dates, wherever they go."""
FORMATS = (TEXT, JSON, SHORT)


class PlainFormatter(logging.Formatter):
    """One line for each record, without control characters; a traceback's lines are indented, so that none looks like
    a record."""

    def __init__(self, prefix: str = "", *, dates: bool = False) -> None:
        super().__init__(prefix + LOG_FORMAT, datefmt=DATE if dates else TIME)
        self._second, self._time = -1, ""
        """The last one that a line was written in, and how."""

    def formatTime(self, record: logging.LogRecord, datefmt: str | None = None) -> str:  # noqa: N802 - logging's name
        second = int(record.created)
        if second != self._second:
            self._second, self._time = second, super().formatTime(record, datefmt)
        return self._time

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        record.message = plain(record.message[:LONGEST])
        return super().formatMessage(record)

    def formatException(  # noqa: N802 - logging's name
        self, ei: tuple[type[BaseException], BaseException, TracebackType | None] | tuple[None, None, None]
    ) -> str:
        return "\n".join(f"  {plain_lines(line)}" for line in super().formatException(ei).split("\n"))


class JsonFormatter(logging.Formatter):
    """One JSON object in each line: time (RFC 3339, with milliseconds), level, logger, message; program and exception
    where there are such."""

    def __init__(self, program: str = "") -> None:
        super().__init__()
        self._program = program

    def format(self, record: logging.LogRecord) -> str:
        at = datetime.fromtimestamp(record.created, timezone.utc).astimezone()
        said = {
            "time": at.isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage()[:LONGEST],
        }
        if self._program:
            said["program"] = self._program
        if record.exc_info:
            said["exception"] = self.formatException(record.exc_info)[:LONGEST]
        return plain_json(json.dumps(said, ensure_ascii=False))


class Written(logging.Handler):
    """Writes lines in a thread of its own. Those that find no room are lost, and counted in the log itself."""

    MOST = 4096
    """Lines that wait."""
    TOGETHER_S = 0.01
    """After a write, lines are gathered for so long: in a burst, one write and one wake-up for each would cost the
    program more than all the rest of the logging."""
    AT_ONCE = 256
    """Lines that are written together."""
    LAST_S = 0.3
    """How long `flush` waits for a stream that takes nothing: less than a program has for its last words."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self.lost = 0
        self._told = 0
        self._stream = stream
        self._descriptor = _descriptor(stream)
        # one that may be put into by what the garbage collector calls, in the middle of a put
        self._waiting: SimpleQueue[str | threading.Event] = SimpleQueue()
        threading.Thread(target=self._write_all, name="macs-log", daemon=True).start()

    def emit(self, record: logging.LogRecord) -> None:
        """Never waits for the stream."""
        try:
            line = self.format(record)
        except Exception:  # noqa: BLE001 - as every handler of logging does
            self.handleError(record)
            return
        if self._waiting.qsize() >= self.MOST:
            self.lost += 1
        else:
            self._waiting.put(line)

    def flush(self) -> None:
        """Wait until what was logged is written, but not for long."""
        written = threading.Event()
        self._waiting.put(written)
        written.wait(self.LAST_S)

    def _write_all(self) -> None:
        while True:
            lines, told = self._gathered(self._waiting.get())
            if (lost := self.lost - self._told) > 0:
                self._told += lost
                lines.insert(0, self.format(_lost_lines(lost)))
            if lines:
                self._write("\n".join(lines))
            if told is not None:
                told.set()  # who waits for it may be ending this program
            elif len(lines) < self.AT_ONCE:
                time.sleep(self.TOGETHER_S)

    def _gathered(self, item: str | threading.Event) -> tuple[list[str], threading.Event | None]:
        """The lines that wait, up to somebody who is to be told when these are written."""
        lines: list[str] = []
        with suppress(Empty):
            while True:
                if isinstance(item, threading.Event):
                    return lines, item
                lines.append(item)
                if len(lines) == self.AT_ONCE:
                    break
                item = self._waiting.get_nowait()
        return lines, None

    def _write(self, text: str) -> None:
        with suppress(OSError, ValueError):  # nobody is there any more, and there is nobody to tell
            if self._descriptor is None:
                self._stream.write(text + "\n")
                self._stream.flush()
                return
            left = memoryview((text + "\n").encode(self._stream.encoding or "utf-8", "backslashreplace"))
            while left:  # past Python's own buffer, whose lock must be free when the program ends
                try:
                    left = left[os.write(self._descriptor, left) :]
                except BlockingIOError:
                    select.select([], [self._descriptor], [])


def _descriptor(stream: TextIO) -> int | None:
    """To be written to itself; None where the stream has to."""
    with suppress(OSError, ValueError, AttributeError):
        return stream.fileno() if os.name == "posix" else None
    return None


def _lost_lines(count: int) -> logging.LogRecord:
    text = "%d lines of this log were lost: what it is written to took nothing"
    return logging.LogRecord("macs.log", logging.WARNING, __file__, 0, text, (count,), None)


def log_to_stderr(form: str | None = None) -> None:
    """Log to stderr, unless somebody has set that up before; other libraries only from WARNING on. ``form``: one of
    `FORMATS`, by default what the environment says."""
    root = logging.getLogger()
    if not root.handlers:
        # no line has these, and to find them out takes longer than to write it
        logging.logThreads = logging.logProcesses = logging.logMultiprocessing = False
        root.addHandler(Written(sys.stderr))
        prefix_logs("", form)


def catch_up() -> None:
    """Wait until what was logged is written, but not for long: what is written next to the log belongs behind it."""
    for handler in logging.getLogger().handlers:
        handler.flush()


def prefix_logs(prefix: str, form: str | None = None) -> None:
    """Put ``prefix`` before each line of our own log, as before those of other programs on the same terminal."""
    form = form or os.environ.get(FORMAT, TEXT)
    dates = form != SHORT and not (sys.stderr is not None and sys.stderr.isatty())
    for handler in logging.getLogger().handlers:
        formatter = JsonFormatter(prefix.strip(" |")) if form == JSON else PlainFormatter(prefix, dates=dates)
        handler.setFormatter(formatter)
