"""What goes out: a declared publisher for each key, limits and priorities, and a thread for what is large."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import zenoh
import zenoh.ext

from macs_zenoh.config import Priority
from macs_zenoh.handles import Callbacks, Handle
from macs_zenoh.losses import Losses
from macs_zenoh.protocol.budget import Ever
from macs_zenoh.protocol.keyexpr import NAMED_ALL, STREAM, sender_of
from macs_zenoh.protocol.policing import Policer, Policy

from .declared import Outlet, Payload, Traffic
from .heartbeat import Counted, Heartbeats
from .loopback import Loopback
from .panics import call, unwatched
from .tracing import Marked, Tracing

log = logging.getLogger("macs.mesh")

CALL, COMMAND = Traffic.CALL, Traffic.COMMAND  # looked up by a Python call otherwise, for each message


class _Bare:
    """Puts with a key that has not been used often enough for a publisher of its own, which costs ten times a put."""

    def __init__(self, session: zenoh.Session, key: str, **way: Any) -> None:
        self._session = session
        self._key = key
        self._way = way

    def put(self, payload: Payload, **mark: Any) -> None:
        """Publish."""
        self._session.put(self._key, payload, **self._way, **mark)


class _Outlet(NamedTuple):
    """Where puts with one key go."""

    publisher: Outlet
    shape: Policy | None
    """The limits on this key, if there are any."""
    kept: bool = False
    """Whether it keeps messages for those that miss some."""


class _Apart(NamedTuple):
    """Two publishers for one key: our own subscriptions, and everybody else's."""

    here: Outlet
    away: Outlet
    settled_at: float
    """When Zenoh surely knows who listens: until then it sends to the router in any case. Never for what is bare."""


class Outgoing:
    """Everything that one session puts. ``drops`` is the mesh's; ``linked`` is kept by it."""

    PUBLISHERS = 4096
    LARGE_BYTES = 128 << 10
    """Larger ones are given to Zenoh by a thread: on a slow link that takes long."""
    COMMANDS_BYTES = 32 << 20
    """So much of large commands may wait for it, and small ones behind them until it is twice as much."""
    COMMANDS_S = 0.5
    """A large one that has waited so long is dropped if others wait behind it: nobody stamps them before they are put,
    so a robot takes them for new."""
    HERE_BYTES = 8 << 10
    """From so much on, Zenoh is not given what only our own subscriptions take: the copy alone takes it longer than
    all else (64 KiB: 25 of 31 us, measured)."""
    SETTLE_S = 2.0
    FRESH_PUTS = 2
    """So often a key is put with before it gets a publisher: whoever names thousands of keys once must not cost
    thousands of declarations."""
    OF_SENDER = 256
    IN_ALL = 32 << 10
    """So many different keys get a publisher as long as the session is open, of one sender and in all. Zenoh forgets
    none of them: 1.5 KB stay in the session and 3 KB in its router (measured with 1.10.2), for each pair of agents of
    which one ever sent to the other. Puts with other keys are bare ones, which take 2 us more."""

    HEARTBEAT_S = 0.5
    """How often a reliable source tells its newest number: so late is the loss of a last message noticed."""

    def __init__(
        self,
        session: zenoh.Session,
        loopback: Loopback,
        policer: Policer,
        drops: Losses,
        *,
        linked: bool,
        backlog_bytes: int,
        from_thread: Callable[[Callable[[], None]], None],
        tracing: Tracing,
    ) -> None:
        self._tracing = tracing
        self._marked = tracing.wanted
        self.policer = policer
        self.linked = linked
        self.drops = drops
        self._session = session
        self._loopback = loopback
        self._outlets: dict[Traffic, OrderedDict[str, _Outlet]] = {kind: OrderedDict() for kind in Traffic}
        self._priorities: dict[str, Priority] = {}
        self._kept: dict[str, int] = {}
        self._apart: OrderedDict[str, _Apart] = OrderedDict()
        self._outlets_lock = threading.Lock()
        self._fresh: OrderedDict[tuple[str, bool], int] = OrderedDict()
        """How often keys were put with that have no publisher yet, by key and whether apart."""
        self._declared = Ever(each=self.OF_SENDER, total=self.IN_ALL)
        """Keys that have or had a publisher, by who sends."""
        self._on_room: Callbacks[Callable[[], None]] = Callbacks()
        self._sender = Sender(backlog_bytes, loopback.put, lambda: from_thread(self._room), drops)
        late = partial(from_thread, self._late)
        self._commands = Sender(self.COMMANDS_BYTES, loopback.put, lambda: None, drops, late, self.COMMANDS_S)
        """For large commands put on the loop, and what follows them with their keys: Zenoh waits for room for their
        fragments (``fragment_wait_ms``)."""
        self._loop_thread = threading.get_ident()
        self._heartbeats = Heartbeats(self.HEARTBEAT_S)

    def link_changed(self, linked: bool) -> None:
        """A router came or went: who listens is unknown again."""
        self.linked = linked
        self._apart.clear()

    def close(self, timeout_s: float) -> None:
        """Send what is queued, for at most so long."""
        self._sender.close(timeout_s)
        self._commands.close(timeout_s)
        self._heartbeats.close(timeout_s)

    def undeclare(self) -> None:
        """Have no publishers any more, on a session that goes on."""
        with self._outlets_lock:
            for outlets in self._outlets.values():
                outlets.clear()
            self._apart.clear()

    def put(self, key: str, payload: Payload, traffic: Traffic) -> None:
        """`Mesh.put`."""
        publisher, shape, kept = self._outlets[traffic].get(key) or self._declare(key, traffic)
        if shape is not None and not self._passes(shape, len(payload)):
            return
        if not (self.linked or kept):
            self.drops["no_route"] += 1
        if self._marked and (mark := self._tracing.mark(key, command=traffic is Traffic.COMMAND)) is not None:
            publisher = Marked(publisher, mark)
        if traffic is COMMAND and self._is_for_thread(key, payload):
            if not self._commands.put(publisher, payload, key):
                self.drops["backlog"] += 1
        elif traffic is not CALL or (len(payload) < self.HERE_BYTES and self._sender.idle):
            self._loopback.put(publisher, payload)
        elif not kept:
            self._put_large(key, publisher, payload)
        elif self._is_quick(payload):
            self._loopback.put(publisher, payload)
        else:  # one publisher numbers them all
            self._put_later(publisher, payload)

    def put_unasked(self, key: str, payload: Payload) -> None:
        """`Mesh.put_unasked`."""
        priority, congestion, express = Traffic.CALL.value
        self._session.put(key, payload, priority=priority, congestion_control=congestion, express=express)

    def limited(self, key: str) -> bool:
        """`Mesh.limited`."""
        shape = self.policer.of(key)
        return shape is not None and shape.limited

    def prioritise(self, key: str, priority: Priority | None) -> None:
        """`Mesh.prioritise`."""
        with self._outlets_lock:
            if self._priorities.get(key) == priority:
                return
            self._priorities.pop(key, None)
            if priority is not None:
                self._priorities[key] = priority
                if len(self._priorities) > self.PUBLISHERS:
                    del self._priorities[next(iter(self._priorities))]
            for outlets in self._outlets.values():
                outlets.pop(key, None)
            self._apart.pop(key, None)

    def keep(self, key: str, samples: int | None) -> bool:
        """`Mesh.keep`."""
        with self._outlets_lock:
            if self._kept.get(key) != samples:
                self._kept.pop(key, None)
                if samples is not None:
                    self._kept[key] = samples
                    if len(self._kept) > self.PUBLISHERS:
                        del self._kept[next(iter(self._kept))]
                for outlets in self._outlets.values():
                    outlets.pop(key, None)
        return self._keeps(key, self.policer.of(key)) > 0

    def way(self, key: str, traffic: Traffic) -> tuple[zenoh.Priority, zenoh.CongestionControl, bool]:
        """How samples with this key travel."""
        usual, congestion, express = traffic.value
        shape = self.policer.of(key)
        wanted = self._priorities.get(key) or (shape.priority if shape is not None else None)
        return getattr(zenoh.Priority, wanted.upper()) if wanted else usual, congestion, express

    @property
    def backlogged(self) -> bool:
        """Whether so much waits to be sent that callers should slow down; `on_room` tells when it is over."""
        return self._sender.backlogged

    @property
    def backlog_bytes(self) -> int:
        """How much waits to be sent."""
        return self._sender.bytes

    @property
    def backlog_sent(self) -> int:
        """How many of what had to wait were sent."""
        return self._sender.sent

    def on_room(self, callback: Callable[[], None]) -> Handle:
        """`Mesh.on_room`."""
        return self._on_room.add(callback)

    def when_sent(self, callback: Callable[[], None]) -> None:
        """Call ``callback``, from any thread, when Zenoh has all that was put before."""
        self._sender.when_sent(lambda: self._commands.when_sent(callback))

    def _late(self) -> None:
        self.drops["backlog"] += 1

    def _room(self) -> None:
        for callback in self._on_room:
            callback()

    def _passes(self, shape: Policy, size: int) -> bool:
        overrun = shape.judge(size, time.monotonic())
        if overrun is not None and overrun.first:
            text = "%s is dropped by a traffic rule: above %s %g of %s (logged once for the rule, counted as %s)"
            log.warning(text, shape.key, overrun.setting, overrun.limit, overrun.rule, overrun.reason)
        return overrun is None

    def _is_quick(self, payload: Payload) -> bool:
        return self._sender.idle and len(payload) <= self.LARGE_BYTES

    def _is_for_thread(self, key: str, payload: Payload) -> bool:
        """Whether a command is left to a thread, since it may take long or would overtake one that does."""
        large = _is_large(payload) and threading.get_ident() == self._loop_thread
        return large or self._commands.has(key)

    def _put_large(self, key: str, publisher: Outlet, payload: Payload) -> None:
        """Our own subscriptions get the payload as it is, now; Zenoh copies it for others, if any listen."""
        apart = self._apart.get(key) or self._declare_apart(key, len(payload))
        if time.monotonic() > apart.settled_at and not apart.away.matching_status.matching:  # type: ignore[attr-defined]
            self._loopback.put_here(apart.here, payload)
        elif self._is_quick(payload):
            self._loopback.put(publisher, payload)
        else:
            self._loopback.put_here(apart.here, payload)
            self._put_later(apart.away, payload)

    def _put_later(self, publisher: Outlet, payload: Payload) -> None:
        if not self._sender.put(publisher, payload):
            self.drops["backlog"] += 1

    def _declare(self, key: str, traffic: Traffic) -> _Outlet:
        """A publisher for a key: unlike a bare put, it sends nothing over the link while nobody there listens."""
        outlets = self._outlets[traffic]
        shape = self.policer.of(key)
        limits = shape if shape is not None and shape.limited else None
        with self._outlets_lock:
            if key in outlets:  # of two threads the other was faster: one source must number all
                return outlets[key]
            keep = self._keeps(key, shape)
            if not keep and self._is_fresh(key, traffic, apart=False):
                return _Outlet(self._bare(key, traffic), limits)
            publisher = self._keeping(key, traffic, keep) if keep else self._publisher(key, traffic)
            outlet = outlets[key] = _Outlet(publisher, limits, bool(keep))
            if len(outlets) > self.PUBLISHERS:
                outlets.popitem(last=False)  # undeclared when the last put with it is done
        return outlet

    def _is_fresh(self, key: str, traffic: Traffic, *, apart: bool) -> bool:
        """Whether a key is put with for one of the first times, or may have no publisher. A robot's topics are few and
        go on: never. With the lock held."""
        if traffic is Traffic.STREAM:
            return False
        puts = self._fresh.pop((key, apart), 0) + 1
        if puts > self.FRESH_PUTS and self._declared.may(sender_of(key), key):
            return False
        self._fresh[key, apart] = puts
        if len(self._fresh) > self.PUBLISHERS:
            self._fresh.popitem(last=False)
        return True

    def _bare(self, key: str, traffic: Traffic, where: zenoh.Locality = zenoh.Locality.DEFAULT) -> _Bare:
        priority, congestion, express = self.way(key, traffic)
        return _Bare(
            self._session,
            key,
            priority=priority,
            congestion_control=congestion,
            express=express,
            allowed_destination=where,
        )

    def _publisher(self, key: str, traffic: Traffic) -> zenoh.Publisher:
        priority, congestion, express = self.way(key, traffic)
        return self._session.declare_publisher(key, priority=priority, congestion_control=congestion, express=express)

    def _keeps(self, key: str, shape: Policy | None) -> int:
        """How many samples to keep of a key; of those that nobody recovers, none."""
        if STREAM.parse(key) is None and NAMED_ALL.parse(key) is None:
            return 0
        return self._kept.get(key) or (shape.cache if shape is not None else None) or 0

    def _keeping(self, key: str, traffic: Traffic, samples: int) -> Counted:
        """A publisher that numbers samples, keeps the last ones, answers questions for them and tells how many there
        are."""
        priority, congestion, express = self.way(key, traffic)
        # an answer that were dropped would be asked for again, so it waits
        answers = zenoh.ext.RepliesConfig(priority=priority, congestion_control=zenoh.CongestionControl.BLOCK)
        publisher = call(
            zenoh.ext.declare_advanced_publisher,
            unwatched(self._session),
            key,
            priority=priority,
            congestion_control=congestion,
            express=express,
            cache=zenoh.ext.CacheConfig(samples, replies_config=answers),
            # numbered; the heartbeat is ours
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
        )
        counted = Counted(self._session, key, publisher)
        self._heartbeats.add(counted)
        return counted

    def _declare_apart(self, key: str, size: int) -> _Apart:
        places = (zenoh.Locality.SESSION_LOCAL, zenoh.Locality.REMOTE)
        with self._outlets_lock:
            fresh = size <= self.LARGE_BYTES and self._is_fresh(key, Traffic.CALL, apart=True)
            if fresh or not self._declared.may(sender_of(key), key):
                bare = [self._bare(key, Traffic.CALL, place) for place in places]
                return _Apart(bare[0], bare[1], math.inf)
        priority, congestion, express = self.way(key, Traffic.CALL)
        here, away = (
            self._session.declare_publisher(
                key, priority=priority, congestion_control=congestion, express=express, allowed_destination=where
            )
            for where in places
        )
        with self._outlets_lock:
            apart = self._apart[key] = _Apart(here, away, time.monotonic() + self.SETTLE_S)
            if len(self._apart) > self.PUBLISHERS:
                self._apart.popitem(last=False)
        return apart


class Sender:
    """A thread that puts what may take long, in order. It starts with the first such payload.

    So long as ``most_s`` a large payload may wait while others wait behind it; then it is not put, and ``on_late``
    called. One that cannot be put, for a reason that nobody thought of, costs itself (``failed`` in ``drops``).
    """

    def __init__(
        self,
        limit_bytes: int,
        put: Callable[[Outlet, Payload], None],
        on_room: Callable[[], None],
        drops: Losses,
        on_late: Callable[[], None] = lambda: None,
        most_s: float = math.inf,
    ) -> None:
        self._drops = drops
        self._most_s = most_s
        self._on_late = on_late
        self._put = put
        self.backlogged = False
        self.sent = 0
        self._limit_bytes = limit_bytes
        self._on_room = on_room
        self._bytes = 0
        self._queue: deque[tuple[Outlet, Payload, str, float] | Callable[[], None]] = deque()
        """What is to be put, and who is to be told that all before it has been."""
        self._keys: Counter[str] = Counter()
        """How much waits of those that whoever puts has named."""
        self._wake = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closing = False

    @property
    def bytes(self) -> int:
        """How much waits."""
        return self._bytes

    @property
    def idle(self) -> bool:
        """Nothing is waiting or being sent."""
        return self._bytes == 0

    def has(self, key: str) -> bool:
        """Whether anything with this key is waiting or being sent."""
        return key in self._keys

    def put(self, publisher: Outlet, payload: Payload, key: str = "") -> bool:
        """Queue it; False when that would be more than the limit (one payload may always wait), or than twice as much
        of small ones with a ``key``, which is for `has`."""
        limit = self._limit_bytes * (2 if key and not _is_large(payload) else 1)
        with self._wake:
            if self._closing or (self._bytes and self._bytes + len(payload) > limit):
                return False
            self._bytes += len(payload)
            self.backlogged = self._bytes > self._limit_bytes // 4
            self._queue.append((publisher, payload, key, time.monotonic()))
            self._keys[key] += 1
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="macs-sender", daemon=True)
                self._thread.start()
            self._wake.notify()
        return True

    def when_sent(self, callback: Callable[[], None]) -> None:
        """Call ``callback``, in any thread, when all that is queued now has been put."""
        with self._wake:
            if not self.idle:
                self._queue.append(callback)
                return
        callback()

    def close(self, timeout_s: float) -> None:
        """Send what is queued, for at most ``timeout_s``, and end."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _run(self) -> None:
        while True:
            with self._wake:
                while not self._queue:
                    if self._closing:
                        return
                    self._wake.wait()
                entry = self._queue.popleft()
            try:
                self._handle(entry)
            except Exception:  # noqa: BLE001 - it is logged
                text = "what a thread was to put, or to tell, failed"
                self._drops.once("failed", text, level=logging.ERROR, exc_info=True)
            if not isinstance(entry, tuple):
                continue
            _, payload, key, _ = entry
            with self._wake:
                self.sent += 1
                self._keys[key] -= 1
                if not self._keys[key]:
                    del self._keys[key]
                self._bytes -= len(payload)
                relieved = self.backlogged and self._bytes < self._limit_bytes // 8
                if relieved:
                    self.backlogged = False
            if relieved:
                self._on_room()

    def _handle(self, entry: tuple[Outlet, Payload, str, float] | Callable[[], None]) -> None:
        if not isinstance(entry, tuple):
            entry()
            return
        publisher, payload, _, since = entry
        if self._queue and _is_large(payload) and time.monotonic() - since > self._most_s:
            self._on_late()
        else:
            self._put(publisher, payload)


def _is_large(payload: Payload) -> bool:
    return len(payload) > Outgoing.LARGE_BYTES
