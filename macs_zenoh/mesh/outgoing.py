"""What goes out: a declared publisher for each key, limits and priorities, and a thread for what is large."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import OrderedDict
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
from .sender import LARGE_BYTES, Sender, close_together, is_large
from .streams import Streams
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
    LARGE_BYTES = LARGE_BYTES
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
        self.streams = Streams(self, loopback, drops, from_thread, late)
        self._loop_thread = threading.get_ident()
        self._heartbeats = Heartbeats(self.HEARTBEAT_S)

    def link_changed(self, linked: bool) -> None:
        """A router came or went: who listens is unknown again."""
        self.linked = linked
        self._apart.clear()

    def close(self, timeout_s: float) -> None:
        """Send what is queued, for at most so long, and tell no more numbers."""
        ends_at = time.monotonic() + timeout_s
        close_together((self._sender, self._commands, self.streams.sender), timeout_s)
        self._heartbeats.close(max(0.1, ends_at - time.monotonic()))

    def undeclare(self) -> None:
        """Have no publishers any more, on a session that goes on."""
        with self._outlets_lock:
            for outlets in self._outlets.values():
                outlets.clear()
            self._apart.clear()

    def put(self, key: str, payload: Payload, traffic: Traffic, *, ruled: bool = True, traced: bool = True) -> bool:
        """`Mesh.put`; without ``ruled`` past all traffic rules, without ``traced`` never marked. False: a rule drops
        it, or there is no router."""
        publisher, shape, kept = self._outlets[traffic].get(key) or self._declare(key, traffic)
        if shape is not None and ruled and not self._passes(shape, len(payload)):
            return False
        goes = self.linked or kept
        if not goes:
            self.drops["no_route"] += 1
        if (
            self._marked
            and traced
            and (mark := self._tracing.mark(key, command=traffic is Traffic.COMMAND)) is not None
        ):
            publisher = Marked(publisher, mark)
        if traffic is COMMAND and self._is_for_thread(key, payload):
            if not self._commands.put(publisher, payload, key):
                self.drops["backlog"] += 1
                goes = False
        elif traffic is not CALL or (len(payload) < self.HERE_BYTES and self._sender.idle):
            self._loopback.put(publisher, payload)
        elif not kept:
            self._put_large(key, publisher, payload)
        elif self._is_quick(payload):
            self._loopback.put(publisher, payload)
        else:  # one publisher numbers them all
            self._put_later(publisher, payload)
        return goes

    def put_by(self, sender: Sender, key: str, payload: Payload, traffic: Traffic) -> bool:
        """Give it to our own subscriptions now, and leave it to a sender if others listen. False: it keeps messages
        for those that miss some, and one publisher numbers them."""
        _, shape, kept = self._outlets[traffic].get(key) or self._declare(key, traffic)
        if kept:
            return False
        if shape is None or self._passes(shape, len(payload)):
            if not self.linked:
                self.drops["no_route"] += 1
            apart = self._apart.get(key) or self._declare_apart(key, len(payload), traffic)
            self._loopback.put_here(apart.here, payload)
            if self._may_listen(apart) and not sender.put(apart.away, payload, key):
                self.drops["backlog"] += 1
        return True

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
        self._sender.when_sent(lambda: self._commands.when_sent(lambda: self.streams.when_sent(callback)))

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
        large = is_large(payload) and threading.get_ident() == self._loop_thread
        return large or self._commands.has(key)

    def _put_large(self, key: str, publisher: Outlet, payload: Payload) -> None:
        """Our own subscriptions get the payload as it is, now; Zenoh copies it for others, if any listen."""
        apart = self._apart.get(key) or self._declare_apart(key, len(payload), CALL)
        if not self._may_listen(apart):
            self._loopback.put_here(apart.here, payload)
        elif self._is_quick(payload):
            self._loopback.put(publisher, payload)
        else:
            self._loopback.put_here(apart.here, payload)
            self._put_later(apart.away, payload)

    @staticmethod
    def _may_listen(apart: _Apart) -> bool:
        """Whether others may listen."""
        return time.monotonic() <= apart.settled_at or apart.away.matching_status.matching  # type: ignore[attr-defined]

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

    def _declare_apart(self, key: str, size: int, traffic: Traffic) -> _Apart:
        places = (zenoh.Locality.SESSION_LOCAL, zenoh.Locality.REMOTE)
        with self._outlets_lock:
            fresh = size <= self.LARGE_BYTES and self._is_fresh(key, traffic, apart=True)
            if fresh or not self._declared.may(sender_of(key), key):
                bare = [self._bare(key, traffic, place) for place in places]
                return _Apart(bare[0], bare[1], math.inf)
        priority, congestion, express = self.way(key, traffic)
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
