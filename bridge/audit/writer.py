"""Writes the record, in a thread of its own: whoever has something to note never waits for a disk.

Several programs may write one file (a gateway's workers, a gateway and a robot): each writes under a lock, and goes on
from the line that is the last one then. What cannot be written waits, `WAITING` notes at most, and is tried again each
second; what is more than that is lost, and the next line says how much.
"""

from __future__ import annotations

import datetime
import errno
import fcntl
import logging
import os
import re
import stat
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from macs_zenoh.errors import ConfigError
from macs_zenoh.protocol.audit_chain import Link, last_link, torn_bytes

from .notes import NO_AUDIT, TEXT, Audit, Shares

log = logging.getLogger("macs.audit")

WAITING = 10_000
AGAIN_S = 1.0
SYNC_S = 1.0
"""After so long what was written goes to the disk for certain; a machine that loses power may lose what is younger."""
CLOSE_S = 1.0
BATCH = 500
_TAIL_BYTES = 256 << 10
_MODE = 0o640

Note = dict[str, Any]


def open_audit(path: str | None, program: str, max_bytes: int, keep: int, on_lost: Callable[[str], None]) -> Audit:
    """The record that settings ask for. Raises ConfigError when it cannot be written."""
    if path is None:
        return NO_AUDIT
    return AuditFile(Path(path).expanduser(), program, max_bytes=max_bytes, keep=keep, on_lost=on_lost)


class AuditFile:
    """The record in a file. ``on_lost`` is called for each note that is not kept, in any thread: ``audit_lost`` for
    want of a file, ``audit_left_out`` since there were too many of the same."""

    def __init__(
        self,
        path: Path,
        program: str,
        *,
        max_bytes: int = 16 << 20,
        keep: int = 20,
        on_lost: Callable[[str], None] = lambda name: None,
    ) -> None:
        """Open it, and note that ``program`` has started. Raises ConfigError."""
        self._path = path
        self._program = program
        self._max_bytes = max_bytes
        self._keep = keep
        self._on_lost = on_lost
        self._notes: deque[Note] = deque()
        self._lost = 0
        self._shares = Shares()
        self._failing = False
        self._closing = False
        self._link: Link | None = None
        self._size = -1
        self._synced = 0.0
        self._fd = -1
        self._wake = threading.Condition()
        try:
            self._open()
            self._resume_or_refuse()
        except OSError as error:
            raise ConfigError(str(path), error.strerror or str(error)) from error
        self.record("started", {}, f"pid {os.getpid()}")
        self._thread = threading.Thread(target=self._run, name="audit", daemon=True)
        self._thread.start()

    # -- from any thread ---------------------------------------------------------------------------------------------

    def record(self, event: str, by: Mapping[str, str], what: str = "", result: str = "done") -> None:
        """As `Audit` says."""
        now = time.monotonic()
        note: Note = {
            "time": datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="milliseconds"),
            "program": self._program,
            "event": event,
            "by": dict(by),
            "what": what[:TEXT],
            "result": result[:TEXT],
        }
        with self._wake:
            if fits := len(self._notes) < WAITING:  # what is lost takes nobody's share, and tells of nothing left out
                left_out = self._shares.take(event, by, result, now)
                if left_out is not None:
                    self._notes.append(note | ({"left_out": left_out} if left_out else {}))
                    self._wake.notify()
                    return
            else:
                self._lost += 1
        self._on_lost("audit_left_out" if fits else "audit_lost")

    def troubles(self) -> dict[str, int]:
        """As `Audit` says."""
        waiting = len(self._notes)
        return {"audit_waiting": waiting} if self._failing or waiting > WAITING // 2 else {}

    def close(self) -> None:
        """Write what waits, and that the program has stopped; `CLOSE_S` at most."""
        self.record("stopped", {})
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._thread.join(CLOSE_S)
        if self._notes:
            log.error("%d lines of %s were not written", len(self._notes), self._path)

    # -- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._notes or self._closing, SYNC_S)
                batch = [self._notes[index] for index in range(min(BATCH, len(self._notes)))]
                lost = self._lost
            if not batch:
                self._sync()
                if self._closing:
                    os.close(self._fd)
                    return
                continue
            try:
                written = self._write(batch, lost)
            except OSError as error:
                self._failed(error)
                if self._closing:
                    return
                with self._wake:
                    self._wake.wait_for(lambda: self._closing, AGAIN_S)
                continue
            with self._wake:
                for _ in range(written):
                    self._notes.popleft()
                self._lost -= lost
            if self._failing:
                self._failing = False
                log.warning("%s can be written again", self._path)

    def _failed(self, error: OSError) -> None:
        if not self._failing:
            self._failing = True
            text = "%s cannot be written: %s. Traffic goes on; %d notes may wait, what is more is lost (audit_lost)"
            log.error(text, self._path, error.strerror or error, WAITING)

    def _write(self, batch: list[Note], lost: int) -> int:
        """Write notes as lines, as many as the file may take; how many. Raises OSError, and none is written then."""
        try:
            self._look()
            while self._size >= self._max_bytes:
                self._rotate()
                self._look()  # who waited for the old file may have begun the new one, or have filled it
            link, lines, count = self._go_on(batch, lost)
            data = b"".join(lines)
            before = self._size
            if (written := os.write(self._fd, data)) != len(data):
                os.ftruncate(self._fd, before)
                raise OSError(errno.ENOSPC, f"only {written} of {len(data)} bytes found room")
            self._link, self._size = link, before + len(data)
        finally:
            fcntl.flock(self._fd, fcntl.LOCK_UN)
        if time.monotonic() > self._synced + SYNC_S:
            self._sync()
        return count

    def _go_on(self, batch: list[Note], lost: int) -> tuple[Link, list[bytes], int]:
        """Where the chain ends after so many of these notes, and their lines."""
        link, lines = self._link or Link(), []
        room = self._max_bytes - self._size
        count = 0
        extra: dict[str, int] = {"lost": lost} if lost else {}
        ends = not self._size or os.pread(self._fd, 1, self._size - 1) == b"\n"
        if not ends and (torn := torn_bytes(self._tail(self._fd))):
            lines.append(b"\n")
            extra["torn"] = torn
        for note in batch:
            line, link = link.line({**note, **extra})
            lines.append(line)
            extra, room, count = {}, room - len(line), count + 1
            if room <= 0:
                break
        return link, lines, count

    def _sync(self) -> None:
        self._synced = time.monotonic()
        try:
            os.fdatasync(self._fd)
        except OSError as error:
            self._failed(error)

    # -- the file ----------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        fd = os.open(self._path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, _MODE)
        if not stat.S_ISREG(os.fstat(fd).st_mode):  # as /dev/null, which takes all and has nothing
            os.close(fd)
            raise OSError(errno.EINVAL, "is no file")
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = fd

    def _resume_or_refuse(self) -> None:
        """Find the last line. Raises ConfigError where there are bytes and no line: it is some other file."""
        self._resume()
        if self._link is None and self._size:
            raise ConfigError(str(self._path), "is no record of ours: it has no line of one")

    def _look(self) -> None:
        """Have the lock of the file that is there, to go on from the line that is its last one now."""
        fcntl.flock(self._fd, fcntl.LOCK_EX)
        known, moved = self._link, False
        while not self._is_there():  # another program has begun a new one, or somebody took it away
            self._open()
            fcntl.flock(self._fd, fcntl.LOCK_EX)
            moved = True
        if moved:
            self._resume()
            self._link = _later(self._link, known)
            return
        size = os.fstat(self._fd).st_size
        if size > self._size:
            self._resume()
        elif size < self._size:  # lines were cut off: we know which ours was, and whoever verifies will miss it
            self._size = size

    def _is_there(self) -> bool:
        try:
            return self._path.stat().st_ino == os.fstat(self._fd).st_ino
        except FileNotFoundError:
            return False

    def _resume(self) -> None:
        self._size = os.fstat(self._fd).st_size
        self._link = last_link(self._tail(self._fd))
        if self._link is None and not self._size and (older := self.older()):
            self._link = last_link(_tail_of(older[-1]))

    def _rotate(self) -> None:
        """Begin a new file; the chain goes on in it. Without a lock, then."""
        older = self.older()
        number = int(older[-1].suffix[1:]) + 1 if older else 1
        os.fdatasync(self._fd)
        self._path.rename(self._path.with_name(f"{self._path.name}.{number:06}"))
        self._open()
        self._size = 0
        for old in self.older()[: -self._keep]:
            old.unlink(missing_ok=True)

    def older(self) -> list[Path]:
        """The files before this one, the oldest first."""
        return older_files(self._path)

    def _tail(self, fd: int) -> bytes:
        size = os.fstat(fd).st_size
        return os.pread(fd, _TAIL_BYTES, max(0, size - _TAIL_BYTES))


def older_files(path: Path) -> list[Path]:
    """What a record was called when a new file was begun, the oldest first."""
    pattern = re.compile(re.escape(path.name) + r"\.\d{6}")
    return sorted(each for each in path.parent.glob(f"{path.name}.*") if pattern.fullmatch(each.name))


def _tail_of(path: Path) -> bytes:
    if not path.is_file():  # a FIFO, say, for which one would wait for ever
        return b""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
        return file.read()


def _later(one: Link | None, other: Link | None) -> Link | None:
    if one is None or other is None:
        return one or other
    return one if one.number >= other.number else other
