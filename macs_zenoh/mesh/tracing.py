"""Messages that are traced on their way: marked where they are put, noted where they come.

Zenoh stamps a marked message at each session and router that it passes. What lies before and behind Zenoh is noted
by programs: by the sender in what is attached to the message, by the receiver in its report. Nothing of it happens
unless somebody asked for it, and until then it costs one look at an empty list.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import zenoh

from macs_zenoh.errors import WireError
from macs_zenoh.protocol import trace
from macs_zenoh.protocol.credit import Credit
from macs_zenoh.protocol.directory import published
from macs_zenoh.protocol.guard import Gate
from macs_zenoh.protocol.keyexpr import STREAM
from macs_zenoh.protocol.trace import DONE, IN, PUT, RECEIVED, ROUTER, SENT, Report, TraceAnswer, TraceRequest

from .declared import Aged, AtOnce, OnAged, OnBatch, OnNumbered, Payload

log = logging.getLogger("macs.mesh")

MOST_WANTED = 64
"""Beginnings of keys that are marked at one time."""
MARKS_PER_S = 2000
"""So many messages are marked, and so many that come marked are noted: who asks for traces slows nobody down."""
ANSWERS_PER_S = 50
"""So often it is told what was noted."""
KNOWN = 4096
"""Keys that are remembered as looked up."""
STALE_NS = 1_000_000_000
_UNKNOWN: Any = object()
_NAMES = {"SEND": SENT, "ROUTE": ROUTER, "RECEIVE": RECEIVED}


class Wanted:
    """One in ``every`` of what is put with a key, until a time."""

    __slots__ = ("commands", "count", "every", "until_s")

    def __init__(self, every: int, until_s: float, *, commands: bool = False) -> None:
        self.every = every
        self.commands = commands
        self.until_s = until_s
        self.count = 0

    def due(self) -> bool:
        """Whether this one is marked."""
        self.count += 1
        return self.count % self.every == 0


class Tracing:
    """What one session marks and notes. From any thread."""

    def __init__(self, own: str, name: str, always_every: int = 0) -> None:
        """``own`` is the session's Zenoh id, as Zenoh's stamps have it, ``name`` what others know it by. With
        ``always_every`` one in so many of all topic data is always marked, and what comes marked is noted."""
        self.own = own
        self.name = name
        self.wanted: dict[str, Wanted] = {}
        """By beginnings of keys; empty: nothing is marked."""
        self._of_key: dict[str, Wanted | None] = {}
        """By keys, as far as they were looked up."""
        self.looks: list[Tracing] = []
        """Itself while what comes marked is noted; empty otherwise."""
        self.on_report: Callable[[Report], None] | None = None
        """Hears of each report."""
        self._until_s = 0.0
        self._always = always_every
        self._reports: deque[Report] = deque(maxlen=trace.MOST_REPORTS)
        self._number = 0
        now = time.monotonic()
        self._marks, self._notes = Credit(MARKS_PER_S, now), Credit(MARKS_PER_S, now)
        self._answers = Credit(ANSWERS_PER_S, now)
        self._noted = threading.local()
        self._lock = threading.Lock()
        if always_every:
            self.looks.append(self)
            self.wanted[STREAM.prefix] = Wanted(always_every, float("inf"))

    @property
    def marks(self) -> bool:
        """Whether anything may be marked now: who could note something looks at this first."""
        return bool(self.wanted)

    # -- asked ---------------------------------------------------------------------------------------------------

    def answer(self, asked: bytes) -> bytes:
        """Do what a request says, and tell what was noted."""
        try:
            request = trace.decode_request(asked)
        except WireError as error:
            log.debug("a request for traces cannot be used: %s", error)
            return trace.encode_answer(TraceAnswer())
        return trace.encode_answer(self.told(request))

    def told(self, request: TraceRequest, beginning: str = "") -> TraceAnswer:
        """The same of what has a key that begins so."""
        now = time.monotonic()
        if not self._answers.take(1, now):
            return TraceAnswer()
        self._want(request, now)
        with self._lock:
            reports = [report for report in self._reports if report.number > request.after]
            missed = max(0, self._number - request.after - len(reports)) if request.after else 0
        return TraceAnswer([report for report in reports if report.key.startswith(beginning)], missed)

    def _want(self, request: TraceRequest, now: float) -> None:
        until_s = now + request.seconds
        if request.look:
            self._until_s = max(self._until_s, until_s)
            if not self.looks:
                self.looks.append(self)
        if request.put:
            found = self.wanted.get(request.put)
            if found is not None:
                found.every, found.until_s = min(found.every, request.every), max(found.until_s, until_s)
            elif len(self.wanted) < MOST_WANTED:
                self.wanted[request.put] = Wanted(request.every, until_s, commands=request.commands)
                self._of_key.clear()
        self.end(now)

    def end(self, now: float) -> None:
        """Let go of what is not wanted any more."""
        for prefix, wanted in list(self.wanted.items()):
            if wanted.until_s < now:
                self.wanted.pop(prefix, None)
                self._of_key.clear()
        if self.looks and now > self._until_s and not self._always:
            self.looks.clear()

    # -- where messages are put ----------------------------------------------------------------------------------

    def note(self, *points: tuple[str, int]) -> None:
        """The next message that this thread puts was at these points, in ns since 1970."""
        self._noted.points = points

    def mark(self, key: str, *, command: bool) -> dict[str, Any] | None:
        """What to give to Zenoh with a message that is put now, if it is to be traced."""
        wanted = self._of_key.get(key, _UNKNOWN)
        if wanted is _UNKNOWN:
            wanted = self._find(key)
        if wanted is None or (wanted.commands and not command) or not wanted.due():
            return None
        return self._marked(wanted)

    def _find(self, key: str) -> Wanted | None:
        found = next((wanted for prefix, wanted in list(self.wanted.items()) if key.startswith(prefix)), None)
        if len(self._of_key) >= KNOWN:
            self._of_key.clear()
        self._of_key[key] = found
        return found

    def _marked(self, wanted: Wanted) -> dict[str, Any] | None:
        points = getattr(self._noted, "points", ())
        self._noted.points = ()
        now = time.monotonic()
        if wanted.until_s < now:
            self.end(now)
            return None
        if not self._marks.take(1, now):
            return None
        number, now_ns = int.from_bytes(os.urandom(8), "little"), time.time_ns()
        if points and now_ns - points[-1][1] > STALE_NS:
            points = ()  # of another message, which was not marked
        return {
            "attachment": trace.encode_mark(number, [*points, (PUT, now_ns)]),
            "timestamp_instrumentation": INSTRUMENTED,
        }

    # -- where they come -----------------------------------------------------------------------------------------

    def begin(self, sample: zenoh.Sample) -> Trace | None:
        """A sample has come; what to tell when it was handled, None if it is not marked."""
        came_ns = time.time_ns()
        now = time.monotonic()
        if now > self._until_s and not self._always:
            self.looks.clear()
            return None
        if not self._notes.take(1, now):
            return None
        attached = sample.attachment
        read = trace.decode_mark(attached.to_bytes()) if attached is not None else None
        if read is None:
            return None
        return Trace(self, str(sample.key_expr), read, sample.timestamp_stack, came_ns)

    def keep(self, key: str, mark: int, way: str, points: list[tuple[str, int, str]]) -> None:
        """A marked message was handled."""
        with self._lock:
            self._number += 1
            report = Report(self._number, mark, key, way, points[: trace.MOST_POINTS])
            self._reports.append(report)
        if self.on_report is not None:
            self.on_report(report)


class Trace:
    """One marked message that is being handled here."""

    def __init__(
        self, tracing: Tracing, key: str, read: tuple[int, list[tuple[str, int]]], stack: Any, came_ns: int
    ) -> None:
        self._tracing = tracing
        self._key = key
        self._mark, self._notes = read
        self._stack = stack
        self._came_ns = came_ns

    def done(self, way: str) -> None:
        """It was handled, all of it: written into sockets, or given to ROS."""
        done_ns = time.time_ns()
        me = self._tracing.own
        records = _records(self._stack)
        sender = next((clock for name, _, clock in records if name == SENT), me)
        receiver = next((clock for name, _, clock in records if name == RECEIVED), me)
        points = [(name, at_ns, sender) for name, at_ns in self._notes]
        # each session routes what it sends and receives as well; those are no routers
        points += [each for each in records if each[0] != ROUTER or each[2] not in (sender, receiver)]
        points += [(IN, self._came_ns, me), (DONE, done_ns, me)]
        # what a session's own id is, nobody is told (`published`); routers tell theirs to everybody
        told = {sender: published(sender), receiver: published(receiver), me: self._tracing.name}
        points = [(name, at_ns, told.get(clock, clock)) for name, at_ns, clock in points]
        self._tracing.keep(self._key, self._mark, way, points)


def _records(stack: Any) -> list[tuple[str, int, str]]:
    """What Zenoh has stamped: where, in ns since 1970, by whose clock."""
    found = []
    for record in stack.records[: trace.MOST_POINTS] if stack is not None else ():
        stamp = record.timestamp()
        name = _NAMES.get(str(record.point).rpartition(".")[2])
        if name is not None and not record.is_custom:
            found.append((name, int(stamp.get_time_as_ntp64().as_nanos()), str(stamp.get_id())))
    return found


class Marked:
    """A publisher for one message that is marked."""

    def __init__(self, publisher: Any, mark: dict[str, Any]) -> None:
        self._publisher = publisher
        self._mark = mark

    def put(self, payload: Payload) -> None:
        """Publish."""
        self._publisher.put(payload, **self._mark)


def noting(
    trace: Trace, on_batch: OnBatch, on_numbered: OnNumbered | None, at_once: AtOnce | None
) -> tuple[OnBatch, OnNumbered | None, AtOnce | None]:
    """Whoever takes one sample, and what is noted when that is done."""

    def take(batch: Iterator[Any]) -> None:
        on_batch(batch)
        trace.done("loop")

    def take_numbered(batch: Iterator[Any]) -> None:
        assert on_numbered is not None
        on_numbered(batch)
        trace.done("loop")

    def take_at_once(key: str, payload: Payload) -> bool:
        assert at_once is not None
        taken = at_once(key, payload)
        if taken:
            trace.done("at once")
        return taken

    return take, take_numbered if on_numbered else None, take_at_once if at_once else None


def noting_aged(trace: Trace, on_aged: OnAged) -> OnAged:
    """The same for what passes a gate."""

    def take(batch: Iterator[Aged]) -> None:
        on_aged(batch)
        trace.done("loop")

    return take


class NotingGate:
    """A gate, and what is noted when it has taken a sample itself."""

    def __init__(self, trace: Trace, gate: Gate) -> None:
        self._trace = trace
        self._gate = gate
        self.admits, self.rescue, self.age = gate.admits, gate.rescue, gate.age

    def first(self, key: str, payload: Payload, age_s: float, now: float) -> bool:
        """Take it, or not."""
        taken = self._gate.first(key, payload, age_s, now)
        if taken:
            self._trace.done("at once")
        return taken


INSTRUMENTED = zenoh.TimestampInstrumentationBuilder().set_send(True).set_route(True).set_receive(True).build()
