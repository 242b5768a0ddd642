"""The Zenoh session: the only module that imports zenoh.

Zenoh has no asyncio API. Here its threads put samples into queues and wake the event loop once per batch; everything
a caller passes in (callbacks, handlers) runs on the loop that opened the mesh.

Zenoh calls back in its own threads, one Python call for each sample, instead of through a thread of each
subscription's own: through one router that is 85 k samples/s instead of 320 k, but a sample here carries all that one
read of a socket brought, one thread switch less is what a single message feels, and one queue keeps the order between
subscriptions.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import operator
import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Awaitable, Callable, Iterable
from enum import Enum
from types import TracebackType
from typing import Any, NamedTuple

import msgspec
import zenoh

from .config import MeshSettings
from .errors import CallTimeout, ConfigError, MacsError, Refused, Unreachable

log = logging.getLogger("macs.mesh")

Payload = bytes | bytearray


class Traffic(Enum):
    """How a sample travels: Zenoh priority, what happens when a link is full, and whether it may wait for others."""

    COMMAND = (zenoh.Priority.REAL_TIME, zenoh.CongestionControl.DROP, True)
    """Commands to robots: first in line, never waits, the next one replaces a lost one."""
    CALL = (zenoh.Priority.INTERACTIVE_HIGH, zenoh.CongestionControl.BLOCK, True)
    """Services, management, messages between agents: kept, in order."""
    STREAM = (zenoh.Priority.DATA, zenoh.CongestionControl.DROP, False)
    """Topic data: dropped when a link is full."""

    __hash__ = object.__hash__  # Enum's own is a Python call, and each put needs it


Sample = tuple[str, Payload]
"""What a subscription receives: key and payload. Not to be changed: others may have the same payload."""

OnBatch = Callable[[list[Sample]], None]
Handler = Callable[[str, bytes], Awaitable[bytes]]


class Subscription:
    """Something declared on the mesh, until `close`. Keep it: Zenoh undeclares what nobody refers to."""

    def __init__(self, *declared: Any) -> None:
        self._declared = declared

    def close(self) -> None:
        """Undeclare it. Closing twice, or after the mesh, is allowed."""
        declared, self._declared = self._declared, ()
        for entity in declared:
            try:
                entity.undeclare()
            except zenoh.ZError as error:
                log.debug("undeclare: %s", error)


Token = Subscription
"""A liveliness token: it lives until `close`, or until its process is gone."""


class _Arrivals:
    """Samples on their way from Zenoh's threads to the loop: one queue for all subscriptions, so that what one
    sender sent on several keys is handled in the order in which it came.

    When the loop is behind, the delivering thread waits a moment, then drops: Zenoh must not be held up for long,
    or other programs' messages wait too.
    """

    LIMIT = 16_384
    LARGE_BYTES = 16 << 10
    LIMIT_BYTES = 128 << 20
    """Of payloads that are large; the others are bounded by their number."""
    BATCH = 512
    PATIENCE_S = 0.1

    def __init__(
        self, loop: asyncio.AbstractEventLoop, wake: Callable[[Callable[[], None]], None], drops: Counter[str]
    ) -> None:
        self._drops = drops
        self._loop = loop
        self._loop_thread = threading.get_ident()
        self._wake = wake
        self._queue: deque[tuple[OnBatch, Sample]] = deque()
        self._waiting = False
        self._large_bytes = 0
        self._large_lock = threading.Lock()
        self._own = threading.local()

    def put(self, publisher: zenoh.Publisher, payload: Payload) -> None:
        """Publish. Zenoh calls our own subscriptions back within this, and they take the payload as it is."""
        self._put(publisher, payload, payload)

    def put_here(self, publisher: zenoh.Publisher, payload: Payload) -> None:
        """Publish to our own subscriptions only: Zenoh finds them, and is given nothing to copy."""
        self._put(publisher, payload, b"")

    def _put(self, publisher: zenoh.Publisher, payload: Payload, zenohs: Payload) -> None:
        self._own.payload = payload
        try:
            publisher.put(zenohs)
        except zenoh.ZError as error:  # the session is closed
            log.debug("put: %s", error)
        finally:
            self._own.payload = None

    def receiver(self, on_batch: OnBatch) -> Callable[[zenoh.Sample], None]:
        """What Zenoh calls, in whatever thread, for each sample of one subscription."""
        queue, limit, large, own = self._queue, self.LIMIT, self.LARGE_BYTES, self._own

        def receive(sample: zenoh.Sample) -> None:
            if len(queue) >= limit and not self._has_room():
                self._drops["loop_behind"] += 1
                return
            payload = getattr(own, "payload", None)
            if payload is None:
                payload = sample.payload.to_bytes()
            if len(payload) > large and not self._has_room_for(len(payload)):
                self._drops["loop_behind"] += 1
                return
            queue.append((on_batch, (str(sample.key_expr), payload)))
            if not self._waiting:
                self._waiting = True
                if threading.get_ident() == self._loop_thread:  # our own sample, inside `put`
                    self._loop.call_soon(self._deliver)
                else:
                    self._wake(self._deliver)

        return receive

    def _deliver(self) -> None:
        self._waiting = False
        queue = self._queue
        arrived = [queue.popleft() for _ in range(min(len(queue), self.BATCH))]
        if queue and not self._waiting:
            self._waiting = True
            self._loop.call_soon(self._deliver)
        freed = sum(len(payload) for _, (_, payload) in arrived if len(payload) > self.LARGE_BYTES)
        if freed:
            with self._large_lock:
                self._large_bytes -= freed
        for on_batch, group in itertools.groupby(arrived, key=operator.itemgetter(0)):
            try:
                on_batch([sample for _, sample in group])
            except Exception:
                log.exception("handling samples failed")  # ours to mend; other subscriptions get theirs

    def _has_room(self) -> bool:
        return self._patiently(lambda: len(self._queue) < self.LIMIT)

    def _has_room_for(self, size: int) -> bool:
        """Take room for a large payload."""
        if not self._patiently(lambda: self._large_bytes == 0 or self._large_bytes + size <= self.LIMIT_BYTES):
            return False
        with self._large_lock:
            self._large_bytes += size
        return True

    def _patiently(self, there_is_room: Callable[[], bool]) -> bool:
        """Wait a moment for room, unless this is the loop's own thread, which would have to make it."""
        deadline = time.monotonic() + self.PATIENCE_S
        while not there_is_room():
            if threading.get_ident() == self._loop_thread or time.monotonic() > deadline:
                return False
            time.sleep(0.001)
        return True


class _Apart(NamedTuple):
    """Two publishers for one key: our own subscriptions, and everybody else's."""

    here: zenoh.Publisher
    away: zenoh.Publisher
    settled_at: float
    """When Zenoh surely knows who listens: until then it sends to the router in any case."""


class Mesh:
    """One program's place on the mesh. Made by `open`; an async context manager.

    ``drops`` counts, by name, what was lost here: ``no_route`` (put while no router was connected), ``backlog``
    (more waiting to be sent than ``backlog_bytes``), ``loop_behind`` (samples came faster than they were handled).
    """

    PUBLISHERS = 4096
    LARGE_BYTES = 128 << 10
    SETTLE_S = 2.0

    def __init__(self, session: zenoh.Session, settings: MeshSettings, backlog_bytes: int = 64 << 20) -> None:
        self.settings = settings
        self.drops: Counter[str] = Counter()
        self.zid = str(session.zid())
        self._session = session
        self._loop = asyncio.get_running_loop()
        self._arrivals = _Arrivals(self._loop, self._from_thread, self.drops)
        self._publishers: dict[Traffic, OrderedDict[str, zenoh.Publisher]] = {kind: OrderedDict() for kind in Traffic}
        self._apart: OrderedDict[str, _Apart] = OrderedDict()
        self._publishers_lock = threading.Lock()
        self._on_room: list[Callable[[], None]] = []
        self._sender = _Sender(backlog_bytes, self._arrivals.put, lambda: self._from_thread(self._room))
        self._routers: set[str] = set()
        self._needs_router = settings.mode == "client"
        self.linked = not self._needs_router
        """Whether a router is connected now; always true for a router."""
        self._on_link: list[Callable[[bool], None]] = []
        self._tasks: set[asyncio.Task[None]] = set()
        # links, not transports, and directly: Zenoh tells of a lost link before it tells that everybody behind it
        # left, and of the lost transport only after that
        on_link = zenoh.handlers.Callback(self._link_changed, indirect=False)
        self._links = session.info.declare_link_events_listener(on_link, history=True)

    @classmethod
    async def open(cls, settings: MeshSettings, *, on_waiting: Callable[[str], None] | None = None) -> Mesh:
        """Join the mesh. A client waits for its first router as long as it takes; ``on_waiting`` hears of it once.

        Raises ConfigError when Zenoh does not accept the configuration, Unreachable when a router cannot listen.
        """
        zenoh.init_log_from_env_or("error")  # RUST_LOG, as with Zenoh's own tools
        waiting = False
        while True:
            config = _zenoh_config(settings)
            try:
                return cls(await asyncio.to_thread(zenoh.open, config), settings)
            except zenoh.ZError as error:
                problem = _first_line(error)
                if settings.mode != "client":
                    raise Unreachable(", ".join(settings.listen) or "the mesh", problem) from error
                if not problem.startswith("Unable to connect"):
                    raise ConfigError("zenoh configuration", problem) from error
                if not waiting:
                    waiting = True
                    (on_waiting or _log_waiting)(", ".join(settings.routers) or "a router")
                await asyncio.sleep(settings.retry_max_ms / 1000)

    async def __aenter__(self) -> Mesh:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Leave the mesh: what was put is sent first, tokens end. A process must not exit without it."""
        for task in self._tasks:
            task.cancel()
        closing = asyncio.ensure_future(asyncio.to_thread(self._close))
        cancelled = False
        while not closing.done():
            try:
                await asyncio.shield(closing)
            except asyncio.CancelledError:  # a second signal: a process that exits with an open session hangs
                cancelled = True
        if cancelled:
            raise asyncio.CancelledError

    def _close(self) -> None:
        self._sender.close(timeout_s=1.0)
        self._session.close()  # type: ignore[no-untyped-call]

    # -- links ---------------------------------------------------------------------------------------------------

    @property
    def routers(self) -> list[str]:
        """Zenoh ids of the routers connected now."""
        return sorted(self._routers)

    def on_link(self, callback: Callable[[bool], None]) -> None:
        """Call ``callback(up)`` whenever the connection to the routers is lost or back."""
        self._on_link.append(callback)

    def _link_changed(self, event: zenoh.LinkEvent) -> None:
        self._from_thread(self._set_link, str(event.link.zid), event.kind == zenoh.SampleKind.PUT)

    def _set_link(self, zid: str, up: bool) -> None:
        before = self.linked
        self._apart.clear()  # who listens is unknown again
        (self._routers.add if up else self._routers.discard)(zid)
        self.linked = bool(self._routers) or not self._needs_router
        if before != self.linked:
            log.info("router %s", "connected" if self.linked else "lost; reconnecting")
        if up and before:
            return
        # losing one router of several shakes what we know about others just as losing the only one does
        for state in [False, True] if not up and self.linked else [up]:
            for callback in self._on_link:
                callback(state)

    # -- publish and subscribe -----------------------------------------------------------------------------------

    def put(self, key: str, payload: Payload, traffic: Traffic = Traffic.CALL) -> None:
        """Publish. From any thread; never waits for more than a full link's ``block_limit_ms``.

        Kept traffic that is large, or that follows a large one, is sent by a thread of its own, so that 20 MiB over
        a slow link do not hold up the loop; between two agents of this program it is not copied at all.
        """
        if not self.linked:
            self.drops["no_route"] += 1
        publisher = self._publishers[traffic].get(key) or self._declare(key, traffic)
        if traffic is not Traffic.CALL or (self._sender.idle and len(payload) <= self.LARGE_BYTES):
            self._arrivals.put(publisher, payload)
        else:
            self._put_apart(self._apart.get(key) or self._declare_apart(key), payload)

    def _put_apart(self, apart: _Apart, payload: Payload) -> None:
        """Our own subscriptions get the payload as it is, now; the sender copies it for others, if any listen."""
        self._arrivals.put_here(apart.here, payload)
        if time.monotonic() > apart.settled_at and not apart.away.matching_status.matching:  # type: ignore[attr-defined]
            return
        if not self._sender.put(apart.away, payload):
            self.drops["backlog"] += 1

    @property
    def backlogged(self) -> bool:
        """Whether so much waits to be sent that callers should slow down; `on_room` tells when it is over."""
        return self._sender.backlogged

    def on_room(self, callback: Callable[[], None]) -> None:
        """Call ``callback`` whenever a backlog has gone."""
        self._on_room.append(callback)

    def _room(self) -> None:
        for callback in self._on_room:
            callback()

    def subscribe(self, key: str, on_batch: OnBatch) -> Subscription:
        """Receive samples in batches. What one sender put is received in its order, over all subscriptions of this
        mesh, as long as it was put with one kind of traffic."""
        callback = zenoh.handlers.Callback(self._arrivals.receiver(on_batch), indirect=False)
        return Subscription(self._session.declare_subscriber(key, callback))

    def _declare(self, key: str, traffic: Traffic) -> zenoh.Publisher:
        """A publisher for a key: unlike a bare put, it sends nothing over the link while nobody there listens."""
        priority, congestion, express = traffic.value
        publishers = self._publishers[traffic]
        with self._publishers_lock:
            publisher = self._session.declare_publisher(
                key, priority=priority, congestion_control=congestion, express=express
            )
            publishers[key] = publisher
            if len(publishers) > self.PUBLISHERS:
                publishers.popitem(last=False)  # undeclared when the last put with it is done
        return publisher

    def _declare_apart(self, key: str) -> _Apart:
        priority, congestion, express = Traffic.CALL.value
        here, away = (
            self._session.declare_publisher(
                key, priority=priority, congestion_control=congestion, express=express, allowed_destination=where
            )
            for where in (zenoh.Locality.SESSION_LOCAL, zenoh.Locality.REMOTE)
        )
        with self._publishers_lock:
            apart = self._apart[key] = _Apart(here, away, time.monotonic() + self.SETTLE_S)
            if len(self._apart) > self.PUBLISHERS:
                self._apart.popitem(last=False)
        return apart

    # -- calls ---------------------------------------------------------------------------------------------------

    async def query(self, key: str, payload: Payload, *, timeout_s: float) -> bytes:
        """Ask whoever serves ``key`` and return the first answer.

        Raises Refused when the answer is a refusal, Unreachable when nobody serves it, CallTimeout.
        """
        done: asyncio.Future[bytes] = self._loop.create_future()

        def settle(answer: bytes | None, error: MacsError | None) -> None:
            if done.done():
                return
            if error is not None:
                done.set_exception(error)
            elif answer is not None:
                done.set_result(answer)

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._from_thread(settle, reply.ok.payload.to_bytes(), None)
            elif reply.err is not None:
                problem = _problem(key, reply.err.payload.to_bytes(), timeout_s)
                self._from_thread(settle, None, problem)

        def on_end() -> None:
            self._from_thread(settle, None, Unreachable(key, "nobody there answers this call"))

        priority, congestion, express = Traffic.CALL.value
        self._session.get(
            key,
            zenoh.handlers.Callback(on_reply, on_end, indirect=False),
            payload=payload,
            timeout=timeout_s,
            priority=priority,
            congestion_control=congestion,
            express=express,
        )
        return await done

    def serve(self, key: str, handler: Handler) -> Subscription:
        """Answer queries on ``key`` with ``await handler(key, payload)``; raise Refused in it to refuse."""

        async def answer(query: zenoh.Query) -> None:
            with query:
                name = str(query.key_expr)
                payload = query.payload.to_bytes() if query.payload is not None else b""
                try:
                    query.reply(query.key_expr, await handler(name, payload))
                except Refused as refusal:
                    query.reply_err(msgspec.json.encode({"refused": refusal.reason}))
                except MacsError as error:
                    query.reply_err(msgspec.json.encode({"refused": str(error)}))
                except Exception:
                    log.exception("call %s failed", name)
                    query.reply_err(msgspec.json.encode({"failed": "internal error, see the log there"}))

        def spawn(query: zenoh.Query) -> None:
            task = self._loop.create_task(answer(query))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

        def on_query(query: zenoh.Query) -> None:
            self._from_thread(spawn, query)

        return Subscription(
            self._session.declare_queryable(key, zenoh.handlers.Callback(on_query, indirect=False), complete=True)
        )

    # -- presence ------------------------------------------------------------------------------------------------

    def declare_token(self, key: str) -> Token:
        """Be there: ``key`` exists on the mesh until the token is closed or this process is gone."""
        return Token(self._session.liveliness().declare_token(key))

    def watch_tokens(self, key: str, on_change: Callable[[str, bool], None]) -> Subscription:
        """Call ``on_change(key, alive)`` for every token that exists, comes or goes."""

        def receive(sample: zenoh.Sample) -> None:
            self._from_thread(on_change, str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        return Subscription(
            self._session.liveliness().declare_subscriber(
                key, zenoh.handlers.Callback(receive, indirect=False), history=True
            )
        )

    async def tokens(self, key: str, *, timeout_s: float = 2.0) -> list[str]:
        """The tokens that exist now, as the routers know them."""
        found: list[str] = []
        ended = asyncio.Event()

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                found.append(str(reply.ok.key_expr))

        def on_end() -> None:
            self._from_thread(ended.set)

        self._session.liveliness().get(
            key, zenoh.handlers.Callback(on_reply, on_end, indirect=False), timeout=timeout_s
        )
        await ended.wait()
        return sorted(found)

    # -- threads -------------------------------------------------------------------------------------------------

    def _from_thread(self, callback: Callable[..., object], *args: object) -> None:
        try:
            self._loop.call_soon_threadsafe(callback, *args)
        except RuntimeError:  # the loop is closed: the program is ending and nobody waits for this
            log.debug("the event loop has ended")


class _Sender:
    """A thread that puts what may take long, in order. It starts with the first such payload."""

    def __init__(
        self, limit_bytes: int, put: Callable[[zenoh.Publisher, Payload], None], on_room: Callable[[], None]
    ) -> None:
        self._put = put
        self.backlogged = False
        self._limit_bytes = limit_bytes
        self._on_room = on_room
        self._bytes = 0
        self._queue: deque[tuple[zenoh.Publisher, Payload]] = deque()
        self._wake = threading.Condition()
        self._thread: threading.Thread | None = None
        self._closing = False

    @property
    def idle(self) -> bool:
        """Nothing is waiting or being sent."""
        return self._bytes == 0

    def put(self, publisher: zenoh.Publisher, payload: Payload) -> bool:
        """Queue it; False when that would be more than the limit (one payload may always wait)."""
        with self._wake:
            if self._closing or (self._bytes and self._bytes + len(payload) > self._limit_bytes):
                return False
            self._bytes += len(payload)
            self.backlogged = self._bytes > self._limit_bytes // 4
            self._queue.append((publisher, payload))
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="macs-sender", daemon=True)
                self._thread.start()
            self._wake.notify()
        return True

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
                publisher, payload = self._queue.popleft()
            self._put(publisher, payload)
            with self._wake:
                self._bytes -= len(payload)
                relieved = self.backlogged and self._bytes < self._limit_bytes // 8
                if relieved:
                    self.backlogged = False
            if relieved:
                self._on_room()


def _problem(key: str, payload: bytes, timeout_s: float) -> MacsError:
    """What an error reply means: ours is JSON, Zenoh's own is the word ``Timeout``."""
    if payload == b"Timeout":
        return CallTimeout(key, timeout_s)
    try:
        answer = msgspec.json.decode(payload, type=dict[str, str])
    except msgspec.DecodeError:
        return Unreachable(key, payload.decode(errors="replace")[:200])
    if "refused" in answer:
        return Refused(answer["refused"])
    return Unreachable(key, answer.get("failed", "unknown failure"))


def _zenoh_config(settings: MeshSettings) -> zenoh.Config:
    """Zenoh's configuration: its file if any, our defaults where the file is silent, our fields, the overrides.

    Raises ConfigError.
    """
    source = settings.config_file
    try:
        config: zenoh.Config = zenoh.Config.from_file(source) if source else zenoh.Config()
    except zenoh.ZError as error:
        raise ConfigError(str(source), _first_line(error)) from error
    silent = zenoh.Config()
    for path, value, chosen in settings.zenoh():
        if chosen or not source or config.get_json(path) == silent.get_json(path):
            _insert(config, path, value)
    if settings.mode == "client":
        # a client tries for a moment and then we try again: waiting inside Zenoh cannot be interrupted
        _insert(config, "connect/timeout_ms", "1000")
        _insert(config, "connect/exit_on_failure", "true")
    for path, value in _split(settings.overrides):
        _insert(config, path, value)
    return config


def _split(overrides: Iterable[str]) -> Iterable[tuple[str, str]]:
    for override in overrides:
        path, _, value = override.partition(":")
        yield path, value


def _insert(config: zenoh.Config, path: str, value: str) -> None:
    try:
        config.insert_json5(path, value)
    except zenoh.ZError as error:
        raise ConfigError(f"zenoh configuration {path}", f"{value} is not accepted: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return str(error).split(" at /")[0].strip().splitlines()[0]


def _log_waiting(target: str) -> None:
    log.warning("no router at %s yet; waiting for it", target)
