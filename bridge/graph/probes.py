"""What a way through the mesh is like: round trips, and messages at a given pace from one session to another.

Bounded, since it is for meshes on which robots drive: of so much a second, for so long, and after everything else.
"""

from __future__ import annotations

import asyncio
import math
import os
import struct
import time
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field

from macs_zenoh.errors import CallTimeout, OutOfRange, Unreachable, UsageError
from macs_zenoh.mesh import Mesh, Sample, Traffic
from macs_zenoh.protocol.keyexpr import PING

MOST_BYTES_PER_S = 10_000_000
"""Of a second of a `bench`: more is for links that nobody else needs."""
MOST_HZ = 2000.0
MOST_BYTES = 1 << 20
MOST_SECONDS = 60.0
LATE_S = 2.0
"""So long after the last one messages may still come."""
GREET_S = 5.0
"""How long two sessions may take until one hears the other."""

_MARK = struct.Struct("<8sQd")
"""Which run, which message of it, and when it was sent, by the monotonic clock."""


@dataclass
class Times:
    """How long each of some things took, in seconds."""

    taken_s: list[float] = field(default_factory=list)

    def at(self, share: float) -> float | None:
        """The time that this share of them did not exceed; None of nothing."""
        if not self.taken_s:
            return None
        ordered = sorted(self.taken_s)
        return ordered[min(len(ordered) - 1, max(0, math.ceil(share * len(ordered)) - 1))]

    def facts(self) -> dict[str, float | None]:
        """In milliseconds: the least, median, 99th percentile and the greatest."""
        shares = {"min_ms": 0.0, "p50_ms": 0.5, "p99_ms": 0.99, "max_ms": 1.0}
        return {name: _ms(self.at(share)) for name, share in shares.items()}


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds * 1000, 3)


@dataclass(frozen=True)
class Load:
    """So many messages a second of so many bytes, for so long."""

    rate_hz: float = 100.0
    size: int = 1000
    seconds: float = 5.0

    def check(self) -> None:
        """Raise OutOfRange, UsageError for more than a mesh should be asked for."""
        for name, value, low, high in (
            ("rate", self.rate_hz, 0.1, MOST_HZ),
            ("size", self.size, _MARK.size, MOST_BYTES),
            ("seconds", self.seconds, 0.1, MOST_SECONDS),
        ):
            if not low <= value <= high:
                raise OutOfRange(name, value, low, high)  # type: ignore[arg-type]  # of floats as well
        if self.rate_hz * self.size > MOST_BYTES_PER_S:
            raise UsageError(
                f"{self.rate_hz:g} messages of {self.size} bytes a second are "
                f"{self.rate_hz * self.size / 1e6:.1f} MB/s; at most {MOST_BYTES_PER_S / 1e6:g} MB/s are sent here"
            )

    @property
    def count(self) -> int:
        """Of all messages."""
        return max(1, round(self.rate_hz * self.seconds))


@dataclass
class Outcome:
    """What became of a load."""

    sent: int = 0
    received: int = 0
    took_s: float = 0.0
    times: Times = field(default_factory=Times)

    def facts(self) -> dict[str, float | int | None]:
        """For programs."""
        rate = self.sent / self.took_s if self.took_s > 0 else None
        return {
            "sent": self.sent,
            "received": self.received,
            "lost": self.sent - self.received,
            "rate_hz": None if rate is None else round(rate, 1),
            **self.times.facts(),
        }


async def through(first: Mesh, second: Mesh, load: Load, tell: Callable[[int, int], None]) -> Outcome:
    """Put messages in one session that another one receives: one way, by one clock, as both are in this process.

    ``tell(sent, of)`` hears how far it is. Raises Unreachable when nothing gets through, OutOfRange, UsageError.
    """
    load.check()
    run, outcome = os.urandom(8), Outcome()
    heard = asyncio.Event()
    padding = bytes(load.size - _MARK.size)
    seen: set[int] = set()

    def receive(batch: Iterator[Sample]) -> None:
        now = time.monotonic()
        for _, payload in batch:
            if len(payload) < _MARK.size:
                continue
            of_run, number, sent_s = _MARK.unpack_from(payload)
            if of_run != run or number in seen:
                continue
            if number:
                seen.add(number)
                outcome.received += 1
                outcome.times.taken_s.append(now - sent_s)
            heard.set()

    key = PING.of(zid=second.zid)
    listening = second.subscribe(key, receive)
    try:
        await _until_heard(first, key, run, heard)
        began = time.monotonic()
        for number in range(1, load.count + 1):
            first.put(key, _MARK.pack(run, number, time.monotonic()) + padding, Traffic.PROBE)
            outcome.sent = number
            tell(number, load.count)
            await asyncio.sleep(began + number / load.rate_hz - time.monotonic())
        outcome.took_s = time.monotonic() - began
        deadline = time.monotonic() + LATE_S
        while outcome.received < outcome.sent and time.monotonic() < deadline:
            heard.clear()
            await asyncio.wait({waiting := asyncio.ensure_future(heard.wait())}, timeout=0.1)
            waiting.cancel()
    finally:
        listening.close()
    return outcome


async def _until_heard(first: Mesh, key: str, run: bytes, heard: asyncio.Event) -> None:
    """Message 0 until it comes: a subscription takes a moment to be known."""
    deadline = time.monotonic() + GREET_S
    while not heard.is_set():
        if time.monotonic() > deadline:
            raise Unreachable("the other session", "nothing comes through; access rules may forbid it (macs doctor)")
        first.put(key, _MARK.pack(run, 0, time.monotonic()), Traffic.PROBE)
        await asyncio.sleep(0.05)


async def round_trips(
    ask: Callable[[bytes], Awaitable[bytes]], load: Load, tell: Callable[[int, int], None], *, open_at_once: int = 64
) -> Outcome:
    """Ask somebody for the same bytes back, at the pace of the load. ``ask`` raises CallTimeout for what is lost.

    Raises what it raises else, OutOfRange, UsageError.
    """
    load.check()
    outcome = Outcome()
    data = os.urandom(load.size)
    asked: set[asyncio.Task[None]] = set()

    async def one() -> None:
        began = time.monotonic()
        try:
            answer = await ask(data)
        except CallTimeout:
            return
        if answer == data:
            outcome.received += 1
            outcome.times.taken_s.append(time.monotonic() - began)

    began = time.monotonic()
    try:
        for number in range(1, load.count + 1):
            if len(asked) >= open_at_once:  # it is slower than this pace: nothing is heaped up
                await asyncio.wait(asked, return_when=asyncio.FIRST_COMPLETED)
            asked.add(task := asyncio.get_running_loop().create_task(one()))
            task.add_done_callback(asked.discard)
            outcome.sent = number
            tell(number, load.count)
            await asyncio.sleep(began + number / load.rate_hz - time.monotonic())
        outcome.took_s = time.monotonic() - began
        await asyncio.gather(*asked)
    finally:
        for task in asked:
            task.cancel()
    return outcome


def summary(times: Sequence[float]) -> str:
    """``min/avg/max/mdev`` of round trips, as ping has it."""
    mean = math.fsum(times) / len(times)
    deviation = math.sqrt(math.fsum((one - mean) ** 2 for one in times) / len(times))
    shown = (min(times), mean, max(times), deviation)
    return "rtt min/avg/max/mdev = " + "/".join(f"{1000 * value:.3f}" for value in shown) + " ms"
