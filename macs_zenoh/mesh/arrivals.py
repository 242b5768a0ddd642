"""What comes from the mesh: from Zenoh's threads to the event loop."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from typing import Any

import zenoh

from macs_zenoh.losses import Losses
from macs_zenoh.protocol.guard import Gate

from .copies import copied
from .declared import Aged, AtOnce, OnAged, OnBatch, OnNumbered, Payload, Sample
from .loopback import Loopback
from .threads import keep_attached
from .tracing import NotingGate, Tracing, noting, noting_aged

log = logging.getLogger("macs.mesh")

URGENT = zenoh.Priority.REAL_TIME
TOPICS, MAY_DROP = zenoh.Priority.DATA, zenoh.CongestionControl.DROP
_CLOCK = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)
"""It goes on while the machine is suspended: what waited meanwhile is as old as it is."""


def now_s() -> float:
    """The time on that clock."""
    return time.clock_gettime(_CLOCK)


Queue = deque[tuple[Callable[[Iterator[Any]], None], tuple[Any, ...], bool]]
"""For whom, the sample, and whether the loop's own thread has put it."""


class _Behind:
    """Of each key of one subscription, how many samples wait for the loop that are large, or came after such a one:
    nothing overtakes them."""

    def __init__(self) -> None:
        self.waiting: Counter[str] = Counter()
        self._lock = threading.Lock()

    def enter(self, key: str, large: bool) -> bool:
        """One more waits; whether it counts."""
        with self._lock:
            counted = large or key in self.waiting
            if counted:
                self.waiting[key] += 1
        return counted

    def leave(self, key: str) -> None:
        """One that counted was handled."""
        with self._lock:
            self.waiting[key] -= 1
            if not self.waiting[key]:
                del self.waiting[key]


class Arrivals:
    """Samples on their way from Zenoh's threads to the loop: one queue for all subscriptions, so that what one
    sender sent on several keys is handled in the order in which it came. What this program has put itself has another
    one, and the two take turns: what the mesh floods us with delays nothing that agents here say to each other.

    When the loop is behind, the delivering thread waits a moment, then drops: Zenoh must not be held up for long,
    or other programs' messages wait too. Topic data is dropped before that, without waiting.

    What the loop's own thread puts cannot wait there: who puts much on the loop makes room after each put, and then
    none of it is dropped.

    A single sample need not go to the loop at all: to wake it takes longer than to pass a message on. It is offered
    to whoever takes samples *at once*, in the thread that brought it. Whoever handles samples has the *turn*, this
    thread or the loop, and at once is only when nothing waits before, so the order stays. Samples in quick
    succession go to the loop, which handles many for little more than one.
    """

    LIMIT = 16_384
    TOPICS_LIMIT = LIMIT // 4 * 3
    """From so many on, topic data is dropped."""
    LOOPED = 2048
    """So many that the loop's own thread has put may wait before `make_room` hands them over."""
    LARGE_BYTES = 16 << 10
    LIMIT_BYTES = 128 << 20
    """Of payloads that are large; the others are bounded by their number."""
    UNWATCHED_BYTES = 16 << 10
    """Handled without a look at the time: it can be thousands of small frames."""
    SAMPLE_BYTES = 256
    """What each sample counts as besides its payload."""
    BATCH_S = 0.002
    """After so long what a handler has gathered is written."""
    TURN_S = 0.004
    """After so long the loop does other things: whoever has something to say there waits for this first."""
    PATIENCE_S = 0.1
    AT_ONCE_BYTES = 128 << 10
    """Larger ones take too long for a thread that reads from the link."""
    PATIENT_S = 0.01
    """So long samples may wait whose subscription is patient: to wake the loop for each costs more than the rest."""
    CALM_S = 0.0003
    """So long after the one before, a sample counts as a single one."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        wake: Callable[[Callable[[], None]], None],
        drops: Losses,
        loopback: Loopback,
        tracing: Tracing,
    ) -> None:
        self._drops = drops
        self._loop = loop
        self._loop_thread = threading.get_ident()
        self._wake = wake
        self._queue: Queue = deque()
        """From elsewhere."""
        self._mine: Queue = deque()
        """Of this program, from whichever of its threads."""
        self.looped = 0
        """How many of these the loop's own thread has put."""
        self._waiting = False
        self._resting = False
        """Whether the loop is woken a little later, for patient subscriptions."""
        self.came_s: float | None = None
        """When the sample came that is being handled, by the monotonic clock: of patient subscriptions."""
        self._handled: tuple[Any, ...] | None = None
        """The sample that is being handled."""
        self._large_bytes = 0
        """Of large payloads: how much other threads have put here in all."""
        self._large_lock = threading.Lock()
        """For that alone: what the loop's thread has put and taken out it counts by itself."""
        self._looped_large_bytes = 0
        self._taken_large_bytes = 0
        self._turn = threading.Lock()
        self._handing_over = False
        """Whether the loop has the turn."""
        self._busy_until = 0.0
        self.asked: deque[zenoh.Query] = deque()
        """Queries on their way to the loop: an emergency stop can be among them, so no sample overtakes them."""
        self._own = loopback.own
        self._tracing = tracing

    @property
    def waiting(self) -> int:
        """How many samples wait for the loop."""
        return len(self._queue) + len(self._mine)

    def receiver(
        self,
        on_batch: OnBatch,
        on_numbered: OnNumbered | None = None,
        *,
        at_once: AtOnce | None = None,
        patient: bool = False,
        traced: bool = True,
    ) -> Callable[[zenoh.Sample], bool]:
        """What Zenoh calls, in whatever thread, for each sample of one subscription; whether there was room for it.
        Samples that their source has numbered go to ``on_numbered``, if it is given; others are offered to
        ``at_once`` first. ``patient``: those without a number are handled within ``PATIENT_S``, several at a time, and
        `came_s` has when each came. ``traced``: those that are marked, while anybody wants to know, are noted."""
        looks = self._tracing.looks if traced else ()
        others, mine, limit, large, own = self._queue, self._mine, self.TOPICS_LIMIT, self.LARGE_BYTES, self._own
        with_time = self._with_time(on_batch) if patient else None

        def receive(sample: zenoh.Sample) -> bool:
            if looks and sample.attachment is not None and (trace := self._tracing.begin(sample)) is not None:
                noted = noting(trace, on_batch, on_numbered, at_once)
                return self.receiver(noted[0], noted[1], at_once=noted[2], traced=False)(sample)
            try:
                payload = own.payload
            except AttributeError:  # the first in this thread
                payload = own.payload = None
                keep_attached()
            elsewhere = payload is None
            queue = others if elsewhere else mine
            looped = not elsewhere and threading.get_ident() == self._loop_thread
            if (self.looped if looped else len(queue)) >= limit and not self._has_room(sample, queue, looped):
                return False
            if elsewhere:
                payload = copied(sample.payload)
            key = str(sample.key_expr)
            info = sample.source_info if on_numbered is not None else None
            if at_once is not None and elsewhere and info is None and self._taken_at_once(at_once, key, payload):
                return True
            if len(payload) > large and not self._has_room_for(len(payload), looped):
                return False
            self.looped += looped
            if info is None or on_numbered is None:
                if with_time is not None:
                    queue.append((with_time, (key, payload, time.monotonic()), looped))
                    if not (self._waiting or self._resting):
                        self._resting = True
                        self._wake(self._rest)
                    return True
                queue.append((on_batch, (key, payload), looped))
            else:
                source = f"{info.source_id.zid}/{info.source_id.eid}"
                queue.append((on_numbered, (key, payload, source, info.source_sn), looped))
            if not self._waiting:
                self._wake_loop()
            return True

        return receive

    def guarded(self, on_aged: OnAged, gate: Gate, behind: _Behind | None = None) -> Callable[[zenoh.Sample], None]:
        """The same for what is judged before it may wait, and where Zenoh's thread must never wait: what the gate does
        not admit is not even copied, what it takes is done, and for the rest there is room or there is not."""
        queue, own = self._queue, self._own
        looks = self._tracing.looks if behind is None else ()
        behind = _Behind() if behind is None else behind

        def handle(samples: Iterator[tuple[str, Payload, float, float, bool]]) -> None:
            on_aged(aged(samples))

        def aged(samples: Iterator[tuple[str, Payload, float, float, bool]]) -> Iterator[Aged]:
            for key, payload, age_s, at, counted in samples:
                now = now_s()
                try:
                    yield key, payload, age_s + now - at, now
                finally:
                    if counted:
                        behind.leave(key)

        def receive(sample: zenoh.Sample) -> None:
            if looks and sample.attachment is not None and (trace := self._tracing.begin(sample)) is not None:
                self.guarded(noting_aged(trace, on_aged), NotingGate(trace, gate), behind)(sample)
                return
            try:
                payload = own.payload
            except AttributeError:  # the first in this thread
                payload = own.payload = None
                keep_attached()
            key, now, age_s = str(sample.key_expr), now_s(), 0.0
            if payload is None:
                encoded, urgent = sample.payload, sample.priority == URGENT
                size = len(encoded)
                if not gate.admits(key, size, urgent, now):
                    if size <= self.AT_ONCE_BYTES:
                        self._try(gate.rescue, key, encoded.to_bytes(), now)
                    return
                payload = copied(encoded)
                if stamp := sample.timestamp:
                    age_s = gate.age(key, stamp.get_id(), stamp.get_time_as_ntp64().as_secs_f64(), now)
                if size <= self.AT_ONCE_BYTES:
                    if key in behind.waiting:
                        self._try(gate.rescue, key, payload, now)  # a stop waits for nothing
                    elif self._try(gate.first, key, payload, age_s, now):
                        return
                if urgent and not gate.admits(key, size, False, now):
                    return  # it is no command, whatever its priority says
            if len(queue) >= self.LIMIT or not self._takes_room_for(len(payload)):
                self._behind("loop_behind")
                return
            counted = behind.enter(key, len(payload) > self.AT_ONCE_BYTES)
            queue.append((handle, (key, payload, age_s, now, counted), False))
            if not self._waiting:
                self._wake_loop()

        return receive

    def _try(self, take: Callable[..., bool | None], *args: Any) -> bool:
        try:
            return bool(take(*args))
        except Exception:
            log.exception("handling a sample failed")  # it may have been half done: not once more
            return True

    def _with_time(self, on_batch: OnBatch) -> Callable[[Iterator[tuple[str, Payload, float]]], None]:
        """A handler of samples with the time at which each came: `came_s` while it is handled."""

        def each(samples: Iterator[tuple[str, Payload, float]]) -> Iterator[Sample]:
            for key, payload, came_s in samples:
                self.came_s = came_s
                yield key, payload

        def handle(samples: Iterator[tuple[str, Payload, float]]) -> None:
            try:
                on_batch(each(samples))
            finally:
                self.came_s = None

        return handle

    def _rest(self) -> None:
        self._loop.call_later(self.PATIENT_S, self._rested)

    def _rested(self) -> None:
        self._resting = False
        if not self._waiting:
            self._deliver()

    def mark(self, on_mark: OnBatch) -> None:
        """Call ``on_mark`` on the loop after all that has arrived so far. From any thread."""
        self._queue.append((on_mark, ("", b""), False))
        if not self._waiting:
            self._wake_loop()

    def _wake_loop(self) -> None:
        self._waiting = True
        if threading.get_ident() == self._loop_thread:  # our own sample, inside `put`
            self._loop.call_soon(self._deliver)
        else:
            self._wake(self._deliver)

    def _taken_at_once(self, at_once: AtOnce, key: str, payload: Payload) -> bool:
        """Whether it was taken in this thread, one of Zenoh's."""
        if self._queue or self._mine or len(payload) > self.AT_ONCE_BYTES or not self._turn.acquire(blocking=False):
            return False
        try:
            calm = time.monotonic() - self._busy_until > self.CALM_S
            return calm and not (self._queue or self._mine or self.asked) and at_once(key, payload)
        except Exception:
            log.exception("handling a sample failed")  # it may have been half done: not once more
            return True
        finally:
            self._busy_until = time.monotonic()
            self._turn.release()

    def make_room(self) -> None:
        """Hand over what waits, if much of it was put by the loop's own thread, which handles it as well: whoever puts
        there for others calls this after each put, and goes on when there is room. Nothing within a handler."""
        if self._handing_over:
            return
        if self.looped > self.LOOPED or (self.looped and self._large_waiting > self.LIMIT_BYTES // 4):
            self._deliver_now()

    def _deliver(self) -> None:
        self._waiting = False
        self._deliver_now()

    def _deliver_now(self) -> None:
        with self._turn:
            self._handing_over = True
            try:
                self._deliver_batch()
            finally:
                self._handing_over = False

    def _deliver_batch(self) -> None:
        queue, other, now = self._mine, self._queue, time.monotonic()
        until = now + self.TURN_S
        while (queue or other) and now < until:  # who sends large samples must feel soon where they wait
            if queue:
                on_batch = queue[0][0]
                waiting = self._taken_out(queue, on_batch, now + self.BATCH_S)
                if not self._hand_over(on_batch, waiting):  # it did not look at them
                    next(waiting, None)
                now = time.monotonic()
            queue, other = other, queue
        self._handled = None  # it may have megabytes
        if (queue or other) and not self._waiting:
            self._waiting = True
            self._loop.call_soon(self._deliver)

    def _taken_out(self, queue: Queue, on_batch: Callable[[Iterator[Any]], None], until: float) -> Iterator[Any]:
        """The samples in a queue as far as they are for this handler, which may have them for so long. Each is taken
        out as it is handled."""
        unwatched = self.UNWATCHED_BYTES
        while queue:
            handler, sample, looped = queue[0]
            if handler is not on_batch and handler != on_batch:
                return
            queue.popleft()
            self.looped -= looped
            size = len(sample[1])
            if size > self.LARGE_BYTES:
                self._taken_large_bytes += size
            self._handled = sample
            yield sample
            unwatched -= size + self.SAMPLE_BYTES
            if unwatched <= 0:
                if time.monotonic() > until:
                    return
                unwatched = self.UNWATCHED_BYTES

    def pass_on(self, on_batch: OnBatch, samples: list[Sample]) -> None:
        """Let a subscription have samples that another one has put in order."""
        handled = self._handled
        self._hand_over(on_batch, self._each(samples))
        self._handled = handled

    def _each(self, samples: list[Sample]) -> Iterator[Sample]:
        for sample in samples:
            self._handled = sample
            yield sample

    def _hand_over(self, on_batch: Callable[[Iterator[Any]], None], samples: Iterator[Any]) -> bool:
        """Let a handler have samples; whether it asked for any. One that cannot be handled, for a reason that nobody
        thought of, costs itself: those behind it are somebody else's."""
        asked = False
        while True:
            self._handled = None
            try:
                on_batch(samples)
                return asked or self._handled is not None
            except Exception:  # noqa: BLE001 - it is logged
                where = self._handled[0] if self._handled else "no key"
                self._drops.once("failed_sample", "a sample on %s failed", where, level=logging.ERROR, exc_info=True)
                if self._handled is None:
                    return asked
                asked = True

    def _has_room(self, sample: zenoh.Sample, queue: Queue, looped: bool) -> bool:
        """Whether there is room for one more. Topic data does not wait for it, nor can the loop's own thread."""
        if looped:
            room = self.looped < self.LIMIT
        elif sample.priority == TOPICS and sample.congestion_control == MAY_DROP:
            self._behind("topics_behind")
            return False
        else:
            room = self._patiently(lambda: len(queue) < self.LIMIT)
        if not room:
            self._behind("loop_behind")
        return room

    def _has_room_for(self, size: int, looped: bool) -> bool:
        """Take room for a large payload; for the loop's own thread there is as much again."""
        most = self.LIMIT_BYTES - size
        if looped:
            if self._large_waiting > most + self.LIMIT_BYTES:
                self._behind("loop_behind")
                return False
            self._looped_large_bytes += size
            return True
        if not self._patiently(lambda: not self._large_waiting or self._large_waiting <= most):
            self._behind("loop_behind")
            return False
        with self._large_lock:
            self._large_bytes += size
        return True

    @property
    def _large_waiting(self) -> int:
        """How much of large payloads waits."""
        return self._large_bytes + self._looped_large_bytes - self._taken_large_bytes

    def _behind(self, name: str) -> None:
        """Count a sample for which there was no room."""
        what = "topic data comes" if name == "topics_behind" else "messages come"
        self._drops.once(name, "%s faster than this program handles it: dropped", what)

    def _takes_room_for(self, size: int) -> bool:
        """The same without waiting, for any payload."""
        if size <= self.LARGE_BYTES:
            return True
        with self._large_lock:
            if self._large_waiting and self._large_waiting + size > self.LIMIT_BYTES:
                return False
            self._large_bytes += size
        return True

    def _patiently(self, there_is_room: Callable[[], bool]) -> bool:
        """Wait a moment for room, in a thread that is not the loop's, which has to make it."""
        deadline = time.monotonic() + self.PATIENCE_S
        while not there_is_room():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.001)
        return True
