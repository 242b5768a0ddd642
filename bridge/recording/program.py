"""A recording as a program: from joining the mesh to the last line about its files. Asyncio."""

from __future__ import annotations

import asyncio
import json
import logging
import signal
import socket
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from msgspec import Struct

import macs_zenoh
from bridge.recording import LIBRARY
from bridge.recording.disk import Disk, Plan
from bridge.recording.recorder import Recorder, Wanted
from bridge.recording.ring import Ring
from bridge.settings.record import is_allowed
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError, Refused, UsageError, WireError
from macs_zenoh.protocol.keyexpr import type_name
from macs_zenoh.protocol.limits import CALL_BYTES
from macs_zenoh.protocol.messages import decode_data
from macs_zenoh.serving import Call
from macs_zenoh.versions import installed

log = logging.getLogger("macs.record")

TELL_S = 1.0
AGAIN_S = 2.0
"""Several robots that are stopped together are one incident."""
LONGEST = 10
"""A file of a ring for which more happens goes on, at most for so many times ``after_s``."""


@dataclass(frozen=True)
class Order:
    """What to record, and where to; see `Wanted`, `Plan` and `RecordSettings`."""

    path: Path
    wanted: Wanted
    compression: str = "lz4"
    max_bytes: int = 0
    max_s: float = 0.0
    split: bool = False
    folder_bytes: int = 0
    ring_s: float = 0.0
    ring_bytes: int = 512 << 20
    on: tuple[str, ...] = ()
    after_s: float = 10.0
    ring_files: int = 100
    allow: tuple[str, ...] = ()
    agent: tuple[int, int] | None = None

    def plan(self, path: Path, about: dict[str, str]) -> Plan:
        """The files."""
        return Plan(path, self.compression, self.max_bytes, self.max_s, self.split, self.folder_bytes, about)


@dataclass
class Report:
    """How a recording is getting on, or what became of it."""

    files: list[Path] = field(default_factory=list)
    messages: int = 0
    bytes: int = 0
    seconds: float = 0.0
    rate: float = 0.0
    """Bytes per second, since the last report."""
    robots: int = 0
    topics: int = 0
    lost: Counter[str] = field(default_factory=Counter)
    free_bytes: int = 0
    reason: str = ""


class Asked(Struct, frozen=True):
    """What the verb ``record`` is asked."""

    action: str = "status"


class Recording:
    """One that goes on: a file, or a ring with the files that are made of it."""

    def __init__(self, order: Order, agent: Agent, on_file: Callable[[Report], None]) -> None:
        self.ended = asyncio.Event()
        self.failed = False
        self._order = order
        self._agent = agent
        self._on_file = on_file
        self._loop = asyncio.get_running_loop()
        self._began = time.monotonic()
        self._reason = ""
        self._bytes_before = 0
        self._told_at = self._began
        self._ring = Ring(order.ring_s, order.ring_bytes) if order.ring_s else None
        self._disk = Disk(order.plan(order.path, self._about()), self._disk_ended) if self._ring is None else None
        self._dumps: dict[Disk, asyncio.Task[None]] = {}
        self._dumped_at = -AGAIN_S
        self._dumps_end = 0.0
        self._dumps_made = 0
        sink = self._ring if self._ring is not None else self._disk
        assert sink is not None
        self.recorder = Recorder(agent, sink, order.wanted, self._triggered)

    def start(self) -> None:
        """Begin. Raises ConfigError: the file cannot be written."""
        if self._disk is not None:
            self._disk.start()
        self.recorder.start()
        self._agent.serve("record", self._asked, most_bytes=CALL_BYTES)

    async def stop(self) -> None:
        """End, with all that waits written."""
        if not self.ended.is_set():
            await self.recorder.last_counts()
        self.recorder.close()
        self._count_losses()
        if self._disk is not None:
            await asyncio.to_thread(self._disk.stop)
            self._on_file(self._report_of(self._disk, self._reason))
        for disk, task in list(self._dumps.items()):
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
            await self._finish(disk, "the recording ended")

    def report(self) -> Report:
        """How it is getting on."""
        self._count_losses()
        report = self._report_of(self._disk, "") if self._disk is not None else Report()
        if self._ring is not None:
            report = Report(messages=len(self._ring), bytes=self._ring.bytes, lost=Counter(self._ring.lost))
        now = time.monotonic()
        report.rate = max(0.0, (report.bytes - self._bytes_before) / max(0.001, now - self._told_at))
        self._bytes_before, self._told_at = report.bytes, now
        report.seconds, report.topics, report.robots = (
            now - self._began,
            self.recorder.topics,
            len(self.recorder.robots),
        )
        return report

    def _count_losses(self) -> None:
        sink = self._ring if self._ring is not None else self._disk
        if sink is not None:
            sink.lost += self.recorder.losses()

    def _report_of(self, disk: Disk, reason: str) -> Report:
        return Report(
            files=list(disk.files),
            messages=disk.messages,
            bytes=disk.bytes,
            seconds=time.monotonic() - self._began,
            lost=Counter(disk.lost),
            free_bytes=disk.free_bytes(),
            reason=reason,
        )

    def _about(self) -> dict[str, str]:
        wanted = self._order.wanted
        return {
            "program": f"{LIBRARY} {installed('macs-zenoh')}",
            "agent": str(self._agent.key),
            "host": socket.gethostname(),
            "robots": ",".join(map(str, sorted(wanted.robots))) or "all",
            "topics": ",".join(wanted.topics) or "all",
            "commands": str(wanted.commands).lower(),
            "headsets": str(wanted.headsets).lower(),
            "began_ns": str(time.time_ns()),
        }

    # -- what ends it --------------------------------------------------------------------------------------------

    def _disk_ended(self, reason: str) -> None:
        """In the disk's thread."""

        def end() -> None:
            self._reason = reason
            self.failed = self._disk is not None and self._disk.problem is not None
            self.ended.set()

        self._loop.call_soon_threadsafe(end)

    # -- a ring --------------------------------------------------------------------------------------------------

    def _triggered(self, trigger: str, about: dict[str, Any]) -> None:
        if self._ring is not None and trigger in self._order.on:
            try:
                self.dump_for_others(trigger, f"robot {about.get('robot')}: {trigger}")
            except Refused as refusal:
                log.warning("the ring is not written for robot %s: %s", about.get("robot"), refusal.reason)
            except ConfigError as error:
                log.error("the ring is not written: %s", error)

    def dump_for_others(self, name: str, reason: str) -> Path:
        """The same as `dump` for robots and agents: not too soon and not too often, since each file may be as large as
        the ring. Raises Refused too."""
        if not self._dumps:
            if time.monotonic() < self._dumped_at + AGAIN_S:
                raise Refused(f"it was written less than {AGAIN_S:g} s ago")
            if self._dumps_made >= self._order.ring_files:
                raise Refused(f"it has written {self._dumps_made} files, as many as [record] ring_files lets it")
        return self.dump(name, reason)

    def dump(self, name: str, reason: str) -> Path:
        """Write what the ring has, and what comes for a while; where a file is being written, it goes on for longer.

        Raises ConfigError, UsageError where there is no ring.
        """
        if self._ring is None:
            raise UsageError("this recording has no ring; it writes all the time")
        now = time.monotonic()
        for open_disk in self._dumps:
            self._dumps_end = min(now + self._order.after_s, self._dumped_at + LONGEST * self._order.after_s)
            log.info("%s goes on: %s", open_disk.plan.path, reason)
            return open_disk.plan.path
        self._dumped_at, self._dumps_end = now, now + self._order.after_s
        path = self._order.path
        stamp = time.strftime("%Y-%m-%d_%H-%M-%S")
        path = path.with_name(f"{path.stem}_{name}_{stamp}{path.suffix}")
        number = 0
        while path.exists():
            number += 1
            path = path.with_name(f"{self._order.path.stem}_{name}_{stamp}_{number}{path.suffix}")
        plan = self._order.plan(path, {**self._about(), "reason": reason})
        disk = Disk(plan, lambda why: log.warning("%s has ended: %s", path, why))
        disk.start()
        self._dumps_made += 1
        self._ring.write(disk)
        self._dumps[disk] = self._loop.create_task(self._after(disk, reason))
        log.info("writing %s: %s", path, reason)
        return path

    async def _after(self, disk: Disk, reason: str) -> None:
        while (left_s := self._dumps_end - time.monotonic()) > 0:  # noqa: ASYNC110 - the end may move
            await asyncio.sleep(left_s)
        del self._dumps[disk]
        self._dumped_at = time.monotonic()
        await self._finish(disk, reason)

    async def _finish(self, disk: Disk, reason: str) -> None:
        assert self._ring is not None
        self._dumps.pop(disk, None)
        self._ring.release(disk)
        await asyncio.to_thread(disk.stop)
        self._on_file(self._report_of(disk, reason))

    async def _asked(self, call: Call) -> bytes:
        """The verb ``record``: ``{"action": "write"}`` writes the ring, ``"status"`` tells, ``"stop"`` ends. What is
        more than to tell is for those whom ``[record] allow`` names."""
        try:
            action = decode_data(Asked, call.data or b"{}").action
        except WireError as error:
            raise Refused('say {"action": "status"}, "write" or "stop"') from error
        if action in ("write", "stop") and not is_allowed(self._order.allow, call.sender_type, call.sender_id):
            raise Refused(f"{call.sender_type}/{call.sender_id} may not: [record] allow does not name it")
        if action == "write":
            try:
                path = self.dump_for_others("asked", f"asked by {call.sender_type}/{call.sender_id}")
                return json.dumps({"file": str(path)}).encode()
            except (ConfigError, UsageError) as error:
                raise Refused(str(error)) from error
        if action == "stop":
            self._reason = f"stopped by {call.sender_type}/{call.sender_id}"
            self.ended.set()
        elif action != "status":
            raise Refused('say {"action": "status"}, "write" or "stop"')
        report = self.report()
        return json.dumps(
            {
                "file": str(self._order.path),
                "ring_s": self._order.ring_s,
                "messages": report.messages,
                "bytes": report.bytes,
                "seconds": round(report.seconds, 1),
                "robots": report.robots,
                "topics": report.topics,
                "lost": dict(report.lost),
            }
        ).encode()


async def record(
    order: Order,
    mesh: MeshSettings,
    *,
    on_waiting: Callable[[str], None],
    on_ready: Callable[[str], None],
    on_progress: Callable[[Report], None],
    on_file: Callable[[Report], None],
    on_asked: Callable[[dict[str, str]], None],
) -> int:
    """Record until it ends or is cancelled; the exit code. ``on_asked`` hears what became of a program's wish for the
    ring. Raises ConfigError, and what `macs_zenoh.join` raises."""
    kind, number = order.agent or (2, 0)
    async with macs_zenoh.join(type_name(kind), id=number or None, settings=mesh, on_waiting=on_waiting) as agent:
        recording = Recording(order, agent, on_file)
        recording.start()
        if order.ring_s and hasattr(signal, "SIGUSR1"):
            loop = asyncio.get_running_loop()
            loop.add_signal_handler(signal.SIGUSR1, lambda: _dump_asked(recording))
            loop.add_signal_handler(signal.SIGUSR2, lambda: on_asked(_dump_for_program(recording)))
        on_ready(str(agent.key))
        try:
            while not recording.ended.is_set():
                waiting = asyncio.ensure_future(recording.ended.wait())
                await asyncio.wait([waiting], timeout=TELL_S)
                waiting.cancel()
                on_progress(recording.report())
        finally:
            await asyncio.shield(recording.stop())
    return int(recording.failed)


def _dump_for_program(recording: Recording) -> dict[str, str]:
    """What became of it: the ``file``, or why it is ``refused``."""
    try:
        return {"file": recording.dump_for_others("asked", "asked by a signal").name}
    except Refused as refusal:
        return {"refused": refusal.reason}
    except (ConfigError, UsageError) as error:
        return {"refused": str(error)}


def _dump_asked(recording: Recording) -> None:
    try:
        recording.dump("asked", "asked by a signal")
    except (ConfigError, UsageError) as error:
        log.error("the ring is not written: %s", error)
