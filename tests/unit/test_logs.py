"""The log is written by a thread of its own: all of it in the usual case, and nobody waits where it is not taken."""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest

from bridge import cli
from bridge.logs import PlainFormatter, Written
from macs_zenoh.errors import Unreachable
from tests.support.processes import ROOT

LINES = 3000
LOGS = f"""
import logging, os, sys
from bridge.logs import log_to_stderr
log_to_stderr()
for number in range({LINES}):
    logging.warning("line %d", number)
"""


def record(text: str) -> logging.LogRecord:
    return logging.LogRecord("macs", logging.WARNING, __file__, 0, text, (), None)


def test_all_is_written_when_a_program_ends() -> None:
    """In its order, though the program ends at once."""
    ended = subprocess.run([sys.executable, "-c", LOGS], cwd=ROOT, capture_output=True, text=True, check=True)
    assert [line.rpartition(" ")[2] for line in ended.stderr.splitlines()] == [str(n) for n in range(LINES)]


def test_a_program_ends_though_nobody_takes_its_log() -> None:
    """What does not fit into the pipe is lost, and the program is not."""
    reads, writes = os.pipe()
    try:
        more = LOGS.replace("line %d", "line %d " + "." * 500)
        subprocess.run([sys.executable, "-c", more], cwd=ROOT, stderr=writes, check=True, timeout=60)
    finally:
        os.close(reads)
        os.close(writes)


def test_lost_lines_are_counted() -> None:
    """More than find room do not make anybody wait; the log says how many they were when it is taken again."""
    reads, writes = os.pipe()
    with os.fdopen(reads) as taken, os.fdopen(writes, "w") as stream:
        log = Written(stream)
        log.setFormatter(PlainFormatter())
        for _ in range(log.MOST + 10_000):
            log.handle(record("." * 100))
        assert log.lost > 0
        told = 0
        for _ in range(log.MOST + 10_000 - log.lost):
            while " lines of this log were lost" in (line := taken.readline()):
                told += int(line.split(": ")[1].split()[0])
            assert line.endswith("." * 100 + "\n")
        assert told == log.lost
        log.flush()


def logged(*options: str, **environment: str) -> list[str]:
    """The lines of a program that logs a text of others and an error."""
    program = """
import logging, sys
from bridge.logs import log_to_stderr, prefix_logs
log_to_stderr(*sys.argv[1:])
prefix_logs("gw1     | ", *sys.argv[1:])
logging.getLogger("macs.test").warning("a %s b", "\\x1b[2J\\n")
try:
    raise OSError("no")
except OSError:
    logging.getLogger("macs.test").exception("failed")
"""
    ended = subprocess.run(
        [sys.executable, "-c", program, *options],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **environment},
    )
    return ended.stderr.splitlines()


def test_lines_have_dates_where_it_is_no_terminal() -> None:
    """A log that is kept says the day, unless another program that has a terminal passes it on."""
    assert re.match(r"gw1     \| \d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d{4} W macs\.test: a ", logged()[0])
    assert re.match(r"gw1     \| \d\d:\d\d:\d\d W macs\.test: a ", logged(MACS_LOG_FORMAT="short")[0])


def test_a_log_can_be_json() -> None:
    """One object in each line, with a time that others read, whatever is in it; by option or environment."""
    for lines in (logged("json"), logged(MACS_LOG_FORMAT="json")):
        first, second = (json.loads(line) for line in lines)
        assert datetime.fromisoformat(first.pop("time")).tzinfo is not None
        assert first == {
            "level": "warning",
            "logger": "macs.test",
            "message": "a \x1b[2J\n b",
            "program": "gw1",
        }
        assert "OSError: no" in second["exception"]
        assert all(line.isprintable() for line in lines)


def test_why_a_verb_failed_stands_behind_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was logged before is written before, though a thread writes it."""
    path = tmp_path / "stderr"
    with path.open("a") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        handler = Written(stream)
        logging.getLogger().addHandler(handler)
        try:
            for number in range(500):
                logging.getLogger("macs.test").warning("line %d", number)
            assert cli._fail("ls", Unreachable("tcp/x:1", "nobody listens there"), 1) == 1
        finally:
            logging.getLogger().removeHandler(handler)
    *lines, last = path.read_text().splitlines()
    assert lines == [f"line {number}" for number in range(500)]
    assert last == "macs ls: tcp/x:1 cannot be reached: nobody listens there"
