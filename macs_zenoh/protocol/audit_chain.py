"""A record whose lines hang on each other: each carries a hash over the one before. Pure.

A line is a JSON object. ``n`` counts from 0, ``previous`` is the SHA-256 of the line before without its end, as hex,
and empty in line 0. There is no secret in it: whoever can write the file can write all of it anew, and cut lines off
its end. So a hash that was noted elsewhere (`Seen`) is what the end is held to.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from enum import Enum
from typing import Any, NamedTuple

FIRST = -1
LINES = 1 << 53


class Link(NamedTuple):
    """Where a chain ends: the number of its last line and the hash over that."""

    number: int = FIRST
    hash: str = ""

    def line(self, fields: Mapping[str, Any]) -> tuple[bytes, Link]:
        """The next line, with its end, and where the chain ends then."""
        row = {"n": self.number + 1, **fields, "previous": self.hash}
        raw = json.dumps(row, separators=(",", ":"), ensure_ascii=False).encode("utf-8", "backslashreplace")
        return raw + b"\n", Link(self.number + 1, hash_of(raw))

    def __str__(self) -> str:
        return f"{self.number}:{self.hash}"


def hash_of(raw: bytes) -> str:
    """Over a line without its end."""
    return hashlib.sha256(raw).hexdigest()


def parse(raw: bytes) -> dict[str, Any] | None:
    """A line's object; None when it is no line of a chain."""
    try:
        row = json.loads(raw)
    except (ValueError, RecursionError):
        return None
    if not isinstance(row, dict) or not isinstance(row.get("previous"), str):
        return None
    number = row.get("n")
    return row if type(number) is int and 0 <= number < LINES else None


def last_link(data: bytes) -> Link | None:
    """Where the chain of these bytes ends, by its last readable whole line; None when there is none."""
    for raw in reversed(data[: data.rfind(b"\n") + 1].splitlines()):
        if (row := parse(raw)) is not None:
            return Link(row["n"], hash_of(raw))
    return None


def torn_bytes(data: bytes) -> int:
    """How much follows the last end of a line."""
    return len(data) - (data.rfind(b"\n") + 1)


# -- verifying -------------------------------------------------------------------------------------------------------


class Kind(str, Enum):
    """What was found. The first group is somebody's doing, the second the life of programs and disks."""

    CHANGED = "changed"
    REMOVED = "removed"
    OUT_OF_ORDER = "out_of_order"
    UNREADABLE = "unreadable"
    CUT_OFF = "cut_off"

    TORN = "torn"
    LOST = "lost"
    KILLED = "killed"
    BEGINS_LATE = "begins_late"
    OPEN_END = "open_end"


FAULTS = frozenset({Kind.CHANGED, Kind.REMOVED, Kind.OUT_OF_ORDER, Kind.UNREADABLE, Kind.CUT_OFF})


class Finding(NamedTuple):
    """One thing that was found, at a line of a file (from 1)."""

    kind: Kind
    file: str
    line: int
    text: str

    @property
    def is_fault(self) -> bool:
        """Whether the record is not what was written."""
        return self.kind in FAULTS


class Seen(NamedTuple):
    """The hash over a line, as it was noted elsewhere."""

    number: int
    hash: str


class Verifier:
    """Reads the lines of a chain, file after file, and says what is wrong with them."""

    def __init__(self, seen: Iterable[Seen] = ()) -> None:
        self.findings: list[Finding] = []
        self.link = Link()
        self.lines = 0
        self._seen = {each.number: each.hash for each in seen}
        self._known: dict[int, str] = {}
        self._torn: tuple[str, int, int] | None = None
        self._running: dict[str, bool] = {}
        self._last_event = ""
        self._place = ("", 0)

    def read(self, file: str, lines: Iterable[bytes]) -> None:
        """Judge the lines of one file; each with its end, where it has one."""
        for number, whole in enumerate(lines, 1):
            self._place = (file, number)
            raw = whole.removesuffix(b"\n")
            row = parse(raw)
            if row is None:
                self._drop_torn()
                self._torn = (file, number, len(raw))
            else:
                self._line(row, raw)

    def finish(self) -> list[Finding]:
        """All lines have been read: what was found, in its order."""
        file, number = self._place
        if self._torn is not None and self._torn[:2] == (file, number):
            self._torn = None
            self._note(Kind.TORN, "the last line is not whole: a program was killed, or the disk was full")
        self._drop_torn()
        for wanted, hashed in self._seen.items():
            if wanted not in self._known:
                self._note(
                    Kind.CUT_OFF, f"line {wanted} was seen, and is not here: the chain ends with {self.link.number}"
                )
            elif self._known[wanted] != hashed:
                self._note(Kind.CHANGED, f"line {wanted} is another one than was seen")
        if self.lines and self._last_event != "stopped":
            text = "the last line is no `stopped`: the program runs, was killed, or lines were cut off here"
            self._note(Kind.OPEN_END, text)
        return self.findings

    def _note(self, kind: Kind, text: str) -> None:
        self.findings.append(Finding(kind, *self._place, text))

    def _line(self, row: dict[str, Any], raw: bytes) -> None:
        number: int = row["n"]
        if self._torn is not None and row.get("torn") == self._torn[2]:
            file, at, size = self._torn
            self.findings.append(Finding(Kind.TORN, file, at, f"{size} bytes of a line that was never finished"))
            self._torn = None
        self._drop_torn()
        if not self.lines:
            if number:
                self._note(Kind.BEGINS_LATE, f"the first line is number {number}: what was before is not here")
        else:
            self._follows(number, row["previous"])
        self.lines += 1
        self.link = Link(number, hash_of(raw))
        if number in self._seen:
            self._known[number] = self.link.hash
        if isinstance(lost := row.get("lost"), int) and lost:
            self._note(Kind.LOST, f"{lost} lines could not be written before this one")
        self._life(str(row.get("program", "")), str(row.get("event", "")))

    def _follows(self, number: int, previous: str) -> None:
        expected = self.link.number + 1
        if number > expected:
            missing = f"line {expected}" if number == expected + 1 else f"lines {expected} to {number - 1}"
            self._note(Kind.REMOVED, f"{missing} should be before this one, which is number {number}")
        elif number < expected:
            self._note(Kind.OUT_OF_ORDER, f"this is line {number}, line {expected} should be here")
        elif previous != self.link.hash:
            self._note(Kind.CHANGED, f"line {number - 1} is not the one that was written, or this one is not")

    def _life(self, program: str, event: str) -> None:
        self._last_event = event
        if event == "started":
            if self._running.get(program):
                self._note(Kind.KILLED, f"{program} had ended before without a word")
            self._running[program] = True
        elif event == "stopped":
            self._running[program] = False

    def _drop_torn(self) -> None:
        if self._torn is not None:
            file, number, size = self._torn
            self.findings.append(
                Finding(Kind.UNREADABLE, file, number, f"{size} bytes that are no line of the record")
            )
            self._torn = None
