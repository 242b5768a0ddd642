"""Writes a recording: a thread that takes what comes from a bounded queue, splits files, keeps to limits, and stops
with a reason where the disk does.

What is lost is counted by name, in the file and for who asks: nothing is dropped that is not told.
"""

from __future__ import annotations

import json
import logging
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Protocol

from bridge.recording.mcap_file import McapFile
from bridge.recording.room import FULL, LEAST, taken
from bridge.recording.streams import LOST, PREFIX, ROS2MSG, Channel
from macs_zenoh.errors import ConfigError

log = logging.getLogger("macs.record")

QUEUE_BYTES = 256 << 20
"""What may wait for the disk."""
CHANNELS = 0xFFFF - 100
"""A file has no more of robots and headsets, whose names are their own: the mesh's have room beside them."""
KEPT = 1 << 16
"""Newest values that a later file begins with; as many agents may be online, and robots' names have no end."""
TURN_S = 0.02
"""Pause between two looks at what has come: a look per message would wake two threads for each."""
FLUSH_S = 0.4
"""So old what is not on the disk may be; a program that is killed loses no more."""


def now_ns() -> int:
    """The time of a message, in ns since 1970."""
    return time.time_ns()


class Entry(NamedTuple):
    """One message of a recording."""

    channel: Channel
    sequence: int
    log_ns: int
    data: bytes
    keep: str = ""
    """Under this name it is the newest: where a file begins later, the newest of each name are its beginning."""
    publish_ns: int = 0


class Sink(Protocol):
    """What takes the messages of a recording, from the loop's thread."""

    def put(self, entry: Entry) -> None:
        """Take one."""


@dataclass(frozen=True)
class Plan:
    """What files to write.

    Attributes:
        path: of the file; with ``split`` a number stands before its ending.
        compression: ``zstd``, ``lz4`` or ``none``.
        max_bytes: a file that has so much is finished; 0: no limit.
        max_s: a file that is so long is finished; 0: no limit.
        split: go on in another file then; else the recording ends.
        folder_bytes: the recording ends when the recordings of its folder have so much together; 0: no limit.
        about: metadata of each file.
    """

    path: Path
    compression: str = "lz4"
    max_bytes: int = 0
    max_s: float = 0.0
    split: bool = False
    folder_bytes: int = 0
    about: Mapping[str, str] = field(default_factory=dict)

    def file(self, number: int) -> Path:
        """The path of the file of this number, from 0."""
        return self.path.with_name(f"{self.path.stem}_{number}{self.path.suffix}") if self.split else self.path


class Disk:
    """Writes in a thread of its own, from `start` to `stop`. ``on_end(reason)`` is called there when it ends by
    itself: a limit was reached, or the disk takes no more."""

    def __init__(self, plan: Plan, on_end: Callable[[str], None] = lambda reason: None) -> None:
        self.plan = plan
        self.files: list[Path] = []
        self.messages = 0
        self.bytes = 0
        """Of all files, as far as they are written."""
        self.lost: Counter[str] = Counter()
        self.problem: OSError | None = None
        self._on_end = on_end
        self._queue: deque[Entry] = deque()
        self._queued_bytes = 0
        self._taken_bytes = 0
        self._ended = False
        self._stopping = threading.Event()
        self._kept: dict[str, Entry] = {}
        self._ids: dict[Channel, int] = {}
        self._lost_told: dict[str, int] = {}
        self._lost_channel = Channel(LOST)
        self._written_before = 0
        self._file: McapFile | None = None
        self._room = 0
        """What this file may have of its folder, as it was when somebody looked."""
        self._began_ns = 0
        self._thread = threading.Thread(target=self._run, name="macs-disk", daemon=True)

    def start(self) -> None:
        """Begin the first file. Raises ConfigError: it cannot be written."""
        self._open()
        self._thread.start()

    def put(self, entry: Entry, *, must: bool = False) -> None:
        """Take a message; one that has no room is counted. ``must``: it has, since it was bounded elsewhere."""
        if self._ended:
            self.lost["after_end" if self.problem is None else "disk_full"] += 1
        elif self.waiting_bytes > QUEUE_BYTES and not must:
            self.lost["disk_behind"] += 1
        else:
            self._queued_bytes += len(entry.data)
            self._queue.append(entry)

    @property
    def waiting_bytes(self) -> int:
        """What has come and is not written."""
        return self._queued_bytes - self._taken_bytes

    @property
    def has_ended(self) -> bool:
        """Whether it takes no more."""
        return self._ended

    def free_bytes(self) -> int:
        """Room on the disk; 0 where nobody can tell."""
        try:
            return shutil.disk_usage(self.plan.path.absolute().parent).free
        except OSError:
            return 0

    def stop(self) -> None:
        """Write what waits and end. Waits for the thread."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()
        self._count_late()

    def _count_late(self) -> None:
        """What was put while the thread ended."""
        if self._queue:
            self.lost["after_end" if self.problem is None else "disk_full"] += len(self._queue)
            self._queue.clear()

    # -- in the thread -------------------------------------------------------------------------------------------

    def _open(self) -> None:
        path = self.plan.file(len(self.files))
        self._look_for_room(path)
        if self.plan.folder_bytes and self._room < LEAST:
            raise ConfigError(str(path.parent), f"{FULL}; take some files away")
        try:
            self._file = McapFile(path, compression=self.plan.compression)
            self.files.append(path)
            self._file.metadata("macs.recording", dict(self.plan.about))
        except FileExistsError as error:
            raise ConfigError(str(path), "it exists already, and nothing is written over") from error
        except OSError as error:
            raise ConfigError(str(path), f"cannot be written: {error.strerror}") from error
        self._ids.clear()
        self._began_ns = 0

    def _run(self) -> None:
        reason, flushed = "", time.monotonic()
        try:
            while not reason:
                last = self._stopping.wait(TURN_S)
                reason = self._write_all()
                now = time.monotonic()
                if self._file is not None and now - flushed > FLUSH_S:
                    flushed = now
                    self._tell_lost()
                    self._file.flush()
                    self._count_bytes()
                    self._look_for_room(self._file.path)
                if last and not self._queue:
                    break
        except OSError as error:
            self._failed(error)
            reason = f"the disk takes no more: {error.strerror or error}"
        except ConfigError as error:
            reason = str(error)
        except Exception:
            log.exception("writing a recording failed")  # a fault of ours must not look as if all were well
            reason = "writing failed, see the log"
        self._ended = True
        self._count_late()
        try:
            self._close()
        except OSError as error:
            self._failed(error)
            reason = reason or f"the disk takes no more: {error.strerror or error}"
        if reason:
            self._on_end(reason)

    def _failed(self, error: OSError) -> None:
        self.problem = self.problem or error

    def _write_all(self) -> str:
        """Write what has come; why to end, if there is a reason."""
        queue = self._queue
        while queue:
            entry = queue.popleft()
            self._taken_bytes += len(entry.data)
            self._write(entry)
            if self.plan.folder_bytes and self._file is not None and self._file.size >= self._room:
                return FULL
            if self._is_full(entry.log_ns):
                if not self.plan.split:
                    return "the recording has the size or length that it may have"
                self._close()
                self._open()
                self._begin(entry.log_ns)
        return ""

    def _look_for_room(self, path: Path) -> None:
        if self.plan.folder_bytes:
            self._room = self.plan.folder_bytes - taken(path.absolute().parent, path.absolute())

    def _is_full(self, log_ns: int) -> bool:
        file, plan = self._file, self.plan
        assert file is not None
        return bool(plan.max_bytes and file.size >= plan.max_bytes) or bool(
            plan.max_s and log_ns - self._began_ns >= plan.max_s * 1e9
        )

    def _write(self, entry: Entry) -> None:
        file, channel = self._file, entry.channel
        assert file is not None
        number = self._ids.get(channel)
        if number is None:
            if len(file.index.channels) >= CHANNELS and not channel.topic.startswith(PREFIX):
                self.lost["too_many_channels"] += 1
                return
            number = self._ids[channel] = self._channel(file, channel)
        if not self._began_ns:
            self._began_ns = entry.log_ns
        self.messages += 1
        file.add(number, entry.sequence, entry.log_ns, entry.publish_ns or entry.log_ns, entry.data)
        if entry.keep and (entry.keep in self._kept or len(self._kept) < KEPT):
            self._kept[entry.keep] = entry

    def _channel(self, file: McapFile, channel: Channel) -> int:
        schema = file.schema(channel.type, ROS2MSG, channel.schema.encode()) if channel.schema else 0
        return file.channel(channel.topic, channel.encoding, schema, channel.metadata)

    def _begin(self, log_ns: int) -> None:
        """What was said before this file and still holds: latched values, who is online."""
        for entry in list(self._kept.values()):
            self._write(entry._replace(log_ns=log_ns, publish_ns=entry.publish_ns or entry.log_ns))

    def _tell_lost(self) -> None:
        if self.lost != self._lost_told:
            self._lost_told = dict(self.lost)
            data = json.dumps({"lost": self._lost_told}).encode()
            self._write(Entry(self._lost_channel, self._lost_channel.next(len(data)), now_ns(), data))
            self.messages -= 1

    def _count_bytes(self) -> None:
        if self._file is not None:
            self.bytes = self._written_before + self._file.size

    def _close(self) -> None:
        file, self._file = self._file, None
        if file is None:
            return
        try:
            file.close(lambda: self._closing(file))
        finally:
            if file.lost:
                self.lost["disk_full"] += file.lost
                self.messages -= file.lost
            self._written_before += file_bytes(file.path)
            self.bytes = self._written_before

    def _closing(self, file: McapFile) -> dict[str, dict[str, str]]:
        lost = dict(self.lost)
        if file.lost:
            lost["disk_full"] = lost.get("disk_full", 0) + file.lost
        return {
            "macs.lost": {name: str(count) for name, count in sorted(lost.items())},
            "macs.end": {"ended_ns": str(now_ns()), "messages": str(file.index.messages)},
        }


def file_bytes(path: Path) -> int:
    """How large a file is; 0 for none."""
    try:
        return path.stat().st_size
    except OSError:
        return 0
