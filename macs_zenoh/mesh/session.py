"""The Zenoh session: a program's place on the mesh."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from functools import partial
from types import TracebackType

import zenoh

from macs_zenoh.config import MeshSettings, Priority, TrafficRule
from macs_zenoh.errors import Unreachable
from macs_zenoh.handles import Callbacks, Handle
from macs_zenoh.losses import Losses
from macs_zenoh.protocol import ping, trace
from macs_zenoh.protocol.directory import published
from macs_zenoh.protocol.guard import Admits, Gate
from macs_zenoh.protocol.keyexpr import PING
from macs_zenoh.protocol.policing import Policer
from macs_zenoh.versions import installed

from .answers import OnAnswer, all_answers
from .arrivals import Arrivals, now_s
from .calls import Calls
from .declared import AtOnce, Handler, OnAged, OnBatch, OnMiss, Payload, Subscription, Token, Traffic
from .leaving import leave
from .link_log import LinkLog
from .loopback import Loopback
from .opening import open_now, open_session
from .outgoing import Outgoing
from .panics import call, end_on_panics, last_words, watched
from .reliable import Recovered
from .streams import Streams
from .token_news import TokenNews
from .tracing import Tracing
from .zenoh_config import check_files, first_line, id_is_chosen, insert, warn_of_lowered, zenoh_config

log = logging.getLogger("macs.mesh")

BEAT_S = 5.0
"""How often it is tried whether Zenoh still works in this process."""


class Mesh:
    """One program's place on the mesh. Made by `open`; an async context manager.

    ``drops`` counts, by name, what was lost here: ``no_route`` (put while no router was connected), ``backlog``
    (more waiting to be sent than ``backlog_bytes``), ``loop_behind`` (samples came faster than they were handled; of
    topics, which are dropped before others, ``topics_behind``),
    ``failed_sample`` (handling it failed, which is a fault of ours),
    ``over_size``, ``over_rate`` and ``over_budget`` (more than a traffic rule allows), ``missed`` (what a reliable
    source did not have any more, or did not send, when it was asked).
    """

    PUBLISHERS = Outgoing.PUBLISHERS
    LARGE_BYTES = Outgoing.LARGE_BYTES

    _is_shared = False
    """Whether the session is somebody else's."""

    def __init__(
        self,
        session: zenoh.Session,
        settings: MeshSettings,
        traffic: Sequence[TrafficRule] = (),
        backlog_bytes: int = 64 << 20,
    ) -> None:
        self.settings = settings
        self.drops = Losses(log)
        self.policer = Policer(traffic, self.drops)
        warn_of_lowered(traffic)
        own = str(session.zid())
        self.id_is_chosen = id_is_chosen(settings)
        """Whether its Zenoh id is in its settings, and no other one is wanted."""
        self.zid = own if self.id_is_chosen else published(own)
        """As whom others know this session. One that was chosen is no secret."""
        self._session = session = watched(session)
        self._liveliness = session.liveliness()
        self._loop = asyncio.get_running_loop()
        self._loop_thread = threading.get_ident()
        end_on_panics(self._loop)
        self._loopback = Loopback.of(own)
        self.tracing = Tracing(own, self.zid, settings.trace_every)
        """What is traced of what this session puts and receives."""
        self._arrivals = Arrivals(self._loop, self._from_thread, self.drops, self._loopback, self.tracing)
        self._recovered: set[Recovered] = set()
        self._needs_router = settings.mode == "client"
        self.linked = not self._needs_router
        """Whether a router is connected now; always true for a router."""
        self._outgoing = Outgoing(
            session,
            self._loopback,
            self.policer,
            self.drops,
            linked=self.linked,
            backlog_bytes=backlog_bytes,
            from_thread=self._from_thread,
            tracing=self.tracing,
        )
        self._calls = Calls(session, self._arrivals, self._outgoing, self._from_thread)
        self.tells: Callable[[], dict[str, int]] = dict
        """What this program tells `macs doctor` of itself, by name: what is so now and should not be."""
        self.address = ""
        """Where headsets reach this program, if it is a gateway."""
        self.told: Callable[[], bytes] | None = None
        """What a gateway tells of its agents (`ping.encode_told`)."""
        self.away: Callable[[], list[tuple[int, int]]] = list
        """(type, id) of a gateway's agents that are silent."""
        self.carried: Callable[[], tuple[int, int] | None] = lambda: None
        """Bytes that its links have sent and received, as far as they are known."""
        self._linked_with: set[str] = set()
        self._link_log = LinkLog(settings.mode)
        self._on_link: Callbacks[Callable[[bool], None]] = Callbacks()
        self._on_router: Callbacks[Callable[[str], None]] = Callbacks()
        # links, not transports, and directly: Zenoh tells of a lost link before it tells that everybody behind it
        # left, and of the lost transport only after that
        on_link = zenoh.handlers.Callback(self._link_changed, indirect=False)
        self._pulse: zenoh.Publisher | None = None
        self._beating = self._loop.call_later(BEAT_S, self._beat)
        self._links = session.info.declare_link_events_listener(on_link, history=True)

    @classmethod
    async def open(
        cls,
        settings: MeshSettings,
        *,
        traffic: Sequence[TrafficRule] = (),
        on_waiting: Callable[[str], None] | None = None,
        quiet: bool = False,
    ) -> Mesh:
        """Join the mesh. A client waits for its first router as long as it takes; ``on_waiting`` hears of it once.
        The ``traffic`` rules hold for what is put and asked here. ``quiet``: without Zenoh's own log of errors.

        Raises ConfigError when Zenoh does not accept the configuration or a file of it is missing, Unreachable when a
        router cannot listen.
        """
        return cls(await open_session(settings, on_waiting=on_waiting, quiet=quiet), settings, traffic)

    @classmethod
    def over(cls, session: zenoh.Session, settings: MeshSettings, traffic: Sequence[TrafficRule] = ()) -> Mesh:
        """On a session that is somebody else's, and goes on when this has been closed."""
        mesh = cls(session, settings, traffic)
        mesh._is_shared = True
        return mesh

    @classmethod
    async def open_once(cls, settings: MeshSettings, *, timeout_s: float) -> Mesh:
        """Join the mesh as a client with one attempt, for who wants to know why it fails.

        Raises Unreachable with Zenoh's reason, ConfigError.
        """
        zenoh.init_log_from_env_or("off")  # what goes wrong is in the error
        config = zenoh_config(settings)
        check_files(config)
        insert(config, "connect/timeout_ms", str(round(timeout_s * 1000)))
        try:
            return cls(await open_now(config), settings)
        except zenoh.ZError as error:
            raise Unreachable(", ".join(settings.routers) or "a router", first_line(error)) from error

    @property
    def backlogged(self) -> bool:
        """Whether so much waits to be sent that callers should slow down; `on_room` tells when it is over."""
        return self._outgoing.backlogged

    @property
    def streams(self) -> Streams:
        """For topic data of others."""
        return self._outgoing.streams

    @property
    def looped(self) -> int:
        """How many samples wait here that were put in the loop's own thread."""
        return self._arrivals.looped

    @property
    def backlog_bytes(self) -> int:
        """How much waits to be sent."""
        return self._outgoing.backlog_bytes

    @property
    def waiting_samples(self) -> int:
        """How many samples have come and wait for the loop."""
        return self._arrivals.waiting

    @property
    def backlog_sent(self) -> int:
        """How many of what had to wait were sent."""
        return self._outgoing.backlog_sent

    def last_words(self, say: Callable[[], None]) -> Handle:
        """Call ``say``, from any thread, before a panic of Zenoh ends this program, which does not leave the mesh."""
        return last_words(say)

    def _beat(self) -> None:
        """Put something to nobody: a panic in a thread of Zenoh's own would show nowhere else."""
        self._pulse = self._pulse or self._session.declare_publisher(PING.of(zid=self.zid))
        call(self._pulse.put, b"")
        self.tracing.end(time.monotonic())
        self._beating = self._loop.call_later(BEAT_S, self._beat)

    async def __aenter__(self) -> Mesh:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Leave the mesh: what was put is sent first, tokens end. A process must not exit without it."""
        self._beating.cancel()
        self._calls.close()
        await leave(self._close)

    def _close(self) -> None:
        self._outgoing.close(timeout_s=1.0)
        if self._is_shared:
            Subscription(*([self._pulse] if self._pulse is not None else []), self._links).close()
            self._outgoing.undeclare()
        else:
            self._session.close()  # type: ignore[no-untyped-call]
        if self.drops:
            log.info("lost in all: %s", ", ".join(f"{name} {count}" for name, count in sorted(self.drops.items())))
        for line in self.policer.report():
            log.info("%s", line)

    # -- links ---------------------------------------------------------------------------------------------------

    @property
    def routers(self) -> list[str]:
        """Zenoh ids of the routers connected now."""
        return sorted(str(zid) for zid in self._session.info.routers_zid())

    @property
    def neighbours(self) -> dict[str, str]:
        """Who has a session with this one now, by Zenoh id: ``router``, ``peer`` or ``client``."""
        return {str(each.zid): str(each.whatami) for each in self._session.info.transports()}

    def on_link(self, callback: Callable[[bool], None]) -> Handle:
        """Call ``callback(up)`` whenever the connection to the routers is lost or back."""
        return self._on_link.add(callback)

    @property
    def links(self) -> list[tuple[str, str]]:
        """The links of this session: the endpoint here, and the one there."""
        return [(str(link.src), str(link.dst)) for link in self._session.info.links()]

    def on_router(self, callback: Callable[[str], None]) -> Handle:
        """Call ``callback(zid)`` whenever a connection to a router has come about, or has come back."""
        return self._on_router.add(callback)

    def _link_changed(self, event: zenoh.LinkEvent) -> None:
        link = event.link
        self._from_thread(self._set_link, str(link.zid), event.kind == zenoh.SampleKind.PUT, str(link.dst))

    def _set_link(self, zid: str, up: bool, where: str) -> None:
        if up and self._on_router and zid in self.routers:
            for told in self._on_router:
                told(zid)
        before = self.linked
        (self._linked_with.add if up else self._linked_with.discard)(zid)
        self.linked = bool(self._linked_with) or not self._needs_router
        self._link_log.changed(zid, up, where, {} if self._needs_router else self.neighbours, linked=self.linked)
        self._outgoing.link_changed(self.linked)
        for recovered in list(self._recovered):
            recovered.link_changed(self.linked)
        if up and before:
            return
        # losing one router of several shakes what we know about others just as losing the only one does
        for state in [False, True] if not up and self.linked else [up]:
            for callback in self._on_link:
                callback(state)

    async def drain(self) -> None:
        """Wait until Zenoh has all that was put here before: what is large, or follows it, waits for a thread. How
        much of it has left this machine Zenoh does not tell."""
        sent: asyncio.Future[None] = self._loop.create_future()

        def tell() -> None:
            if not sent.done():
                sent.set_result(None)

        self._outgoing.when_sent(lambda: self._from_thread(tell))
        await sent

    # -- publish and subscribe -----------------------------------------------------------------------------------

    def put(self, key: str, payload: Payload, traffic: Traffic = Traffic.CALL, *, beside: bool = False) -> bool:
        """Publish; returns whether it goes. From any thread; waits for no more than a full link's ``block_limit_ms``.

        Kept traffic that is large, or that follows a large one, is sent by a thread of its own, so that 20 MiB over
        a slow link do not hold up the loop; between two agents of this program it is not copied at all.

        What is more than a traffic rule allows is dropped and counted; where `limited`, put each message by itself.
        What is said ``beside`` the traffic no rule counts, and no trace takes for it.
        """
        return self._outgoing.put(key, payload, traffic, ruled=not beside, traced=not beside)

    def put_unasked(self, key: str, payload: Payload) -> None:
        """Put without having heard that anybody listens, past all traffic rules: it goes to the router in any case,
        as from a program that asks nobody. For who tries what a router lets through."""
        self._outgoing.put_unasked(key, payload)

    def limited(self, key: str) -> bool:
        """Whether a traffic rule may drop some of what is put with this key, so that messages count one by one."""
        return self._outgoing.limited(key)

    def prioritise(self, key: str, priority: Priority | None) -> None:
        """Put with this key at a priority of its own, whatever rules say; None: no more. From any thread."""
        self._outgoing.prioritise(key, priority)

    def keep(self, key: str, samples: int | None) -> bool:
        """Keep so many samples of a key for receivers that miss some, whatever rules say; None: as rules say. Returns
        whether any are kept.

        For topic data, and for messages between named agents to all: nothing else is asked for again. From any thread.
        Receivers must subscribe with ``reliable``.
        """
        return self._outgoing.keep(key, samples)

    def on_room(self, callback: Callable[[], None]) -> Handle:
        """Call ``callback`` whenever a backlog has gone."""
        return self._outgoing.on_room(callback)

    def make_room(self) -> None:
        """Hand over what waits, if much of it was put by the loop's own thread, which handles it as well: whoever puts
        there for others calls this after each put, and goes on when there is room. Nothing within a handler."""
        self._arrivals.make_room()

    def subscribe(
        self,
        key: str,
        on_batch: OnBatch,
        *,
        at_once: AtOnce | None = None,
        reliable: bool = False,
        on_miss: OnMiss | None = None,
        patient: bool = False,
    ) -> Subscription:
        """Receive samples in batches. What one sender put is received in its order, over all subscriptions of this
        mesh, as long as it was put with one kind of traffic.

        ``at_once`` is offered a sample that comes from elsewhere while nothing else waits, in a thread of Zenoh's,
        which saves it the way to the loop; what it does not take goes to ``on_batch``.

        ``reliable``: what a source keeps (`keep`) is received in order and once, also through outages. Samples that
        it has no more are counted as ``missed``, and ``on_miss(key, count)`` hears of them. What sources do not keep
        is received as without it.

        ``patient``: to handle them a hundredth of a second later is soon enough, which costs less; `came_s` says when
        one came.
        """
        if reliable:
            recovered = Recovered(
                self._session,
                self._arrivals,
                key,
                on_batch,
                partial(self._lost, on_miss),
                at_once=at_once,
                patient=patient,
                linked=self.linked,
                on_close=self._recovered.discard,
            )
            self._recovered.add(recovered)
            return recovered.declare()
        receive = self._arrivals.receiver(on_batch, at_once=at_once, patient=patient)
        return Subscription(self._session.declare_subscriber(key, zenoh.handlers.Callback(receive, indirect=False)))

    @property
    def came_s(self) -> float:
        """When the sample that is being handled came, by the monotonic clock; as far as that is known, else now."""
        came_s = self._arrivals.came_s
        return time.monotonic() if came_s is None else came_s

    def subscribe_guarded(self, key: str, on_aged: OnAged, gate: Gate) -> Subscription:
        """Receive samples in batches, in the same order as with `subscribe`; ``gate`` judges each in the thread of
        Zenoh's that brought it, whatever waits, and may take it."""
        receive = self._arrivals.guarded(on_aged, gate)
        return Subscription(self._session.declare_subscriber(key, zenoh.handlers.Callback(receive, indirect=False)))

    def _lost(self, on_miss: OnMiss | None, key: str, count: int) -> None:
        text = f"{count} lost, which the source has no more, or does not send again"
        self.drops.note("missed", key, text, count)
        if on_miss is not None:
            on_miss(key, count)

    def watch_stamps(self, key: str, on_stamp: Callable[[float, str], None]) -> Subscription:
        """Call ``on_stamp(wall clock in s, zid)`` for every sample with a timestamp: our programs put none on theirs,
        so it is the first router's."""

        def receive(sample: zenoh.Sample) -> None:
            if (stamp := sample.timestamp) is not None:
                self._from_thread(on_stamp, stamp.get_time().timestamp(), str(stamp.get_id()))

        return Subscription(self._session.declare_subscriber(key, zenoh.handlers.Callback(receive, indirect=False)))

    def watch_dropping(self, key: str, on_sample: Callable[[bool], None]) -> Subscription:
        """Call ``on_sample`` for every sample, with whether it may be dropped where a link is full."""

        def receive(sample: zenoh.Sample) -> None:
            self._from_thread(on_sample, sample.congestion_control == zenoh.CongestionControl.DROP)

        return Subscription(self._session.declare_subscriber(key, zenoh.handlers.Callback(receive, indirect=False)))

    # -- calls ---------------------------------------------------------------------------------------------------

    async def query(self, key: str, payload: Payload, *, timeout_s: float, traffic: Traffic = Traffic.CALL) -> bytes:
        """Ask whoever serves ``key`` and return the first answer, which travels as the question does.

        Raises Refused when the answer is a refusal, NotServed, Unreachable, CallTimeout; OutOfRange when
        it is larger than a traffic rule allows: of what a rule limits, only the size holds for queries.
        """
        return await self._calls.query(key, payload, timeout_s=timeout_s, traffic=traffic)

    def ask(
        self, key: str, payload: Payload, on_answer: OnAnswer, *, of: Hashable, timeout_s: float, traffic: Traffic
    ) -> None:
        """The same for who asks hundreds, and can wait a few milliseconds more: answers are looked for, together those
        ``of`` one who is asked. ``on_answer`` is called once, later, with one or one of these errors. Raises
        OutOfRange itself."""
        self._calls.ask(key, payload, on_answer, of=of, timeout_s=timeout_s, traffic=traffic)

    async def ask_all(self, key: str, *, timeout_s: float) -> list[tuple[str, bytes]]:
        """Ask everybody who serves a key, as the routers' admin space (``@/*/router``), and return every answer with
        its own key. Refusals are left out, and who is not allowed to ask gets none: Zenoh does not say."""
        return await self._calls.ask_all(key, timeout_s=timeout_s)

    def serve(
        self,
        key: str,
        handler: Handler,
        *,
        stand_in: bool = False,
        first: Callable[[str, bytes], None] | None = None,
        gate: Admits | None = None,
        most_bytes: int | None = None,
        in_order: bool = False,
    ) -> Subscription:
        """Answer queries on ``key`` with ``await handler(key, payload)``; raise Refused in it to refuse. What brings
        more than ``most_bytes`` is refused unread.

        With ``stand_in`` it is asked only where nobody else serves the key. ``first`` is called at once with every
        query, in a thread of Zenoh's; unless it raises Refused, the answer is the handler's, on the loop. What the
        ``gate`` does not admit has no answer. A handler ``in_order`` is no coroutine: it is called before anybody does
        anything about later queries, raises nothing, and returns what is awaited.
        """
        return self._calls.serve(
            key, handler, stand_in=stand_in, first=first, gate=gate, most_bytes=most_bytes, in_order=in_order
        )

    def answer_pings(self) -> Subscription:
        """Let `macs doctor` measure the way to this program, and learn its clock and version."""
        macs, wheel = installed("macs-zenoh"), installed("eclipse-zenoh")

        async def answer(key: str, payload: bytes) -> bytes:
            drops, now = dict(self.drops), self.tells()
            said = ping.pong(
                self.settings,
                now_s=time.time(),
                macs=macs,
                zenoh=wheel,
                drops=drops,
                now=now,
                away=self.away(),
                address=self.address,
                link_bytes=self.carried(),
            )
            if payload.startswith(trace.PREFIX):
                payload = self.tracing.answer(payload)
            if payload == ping.AGENTS and self.told is not None:
                payload = self.told()
            return ping.encode(said, payload)

        key = PING.of(zid=self.zid)
        gate = ping.PingGate(now_s(), lambda: self.drops.note("flooded", key, "more pings than are answered"))
        return self.serve(key, answer, gate=gate)

    # -- presence ------------------------------------------------------------------------------------------------

    def declare_token(self, key: str) -> Token:
        """Be there: ``key`` exists on the mesh until the token is closed or this process is gone."""
        return Token(self._liveliness.declare_token(key))

    def watch_tokens(self, key: str, on_change: Callable[[str, bool], None]) -> Subscription:
        """Call ``on_change(key, alive)`` for every token that exists, comes or goes."""
        news = TokenNews(self._loop, self._from_thread, on_change)
        return Subscription(
            self._liveliness.declare_subscriber(
                key, zenoh.handlers.Callback(news.receive, indirect=False), history=True
            )
        )

    async def tokens(self, key: str, *, timeout_s: float = 2.0) -> list[str]:
        """The tokens that exist now, as the routers know them: this session's own for certain, what another one has
        declared a few milliseconds ago perhaps not yet. Where routers do not answer in time, those known by then."""
        found = await all_answers(lambda replies: self._liveliness.get(key, replies, timeout=timeout_s))
        return sorted(str(token.key_expr) for token in found)

    # -- threads -------------------------------------------------------------------------------------------------

    def _from_thread(self, callback: Callable[..., object], *args: object) -> None:
        # a token that is declared on the loop calls back there, and the loop need not be woken
        here = threading.get_ident() == self._loop_thread
        try:
            (self._loop.call_soon if here else self._loop.call_soon_threadsafe)(callback, *args)
        except RuntimeError:  # the loop is closed: the program is ending and nobody waits for this
            log.debug("the event loop has ended")
