"""A Zenoh session on which our programs are ROS nodes, as ROS 2's own Zenoh middleware (rmw_zenoh) has them.

What a node of the real middleware does not survive is never sent (docs/rmw-zenoh.md): an attachment is always whole, a
payload is always CDR, and the only queries are those of a service's exact key, with both. Callbacks are called in
Zenoh's threads.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import threading
import time
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Any, NamedTuple

import zenoh
import zenoh.ext
from msgspec import structs

from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import UsageError
from macs_zenoh.handles import Callbacks, Handle
from macs_zenoh.losses import Losses
from macs_zenoh.protocol.rmw_zenoh.attachment import Attachment, encode_attachment, gid_of, parse_attachment
from macs_zenoh.protocol.rmw_zenoh.cdr import looks_like_cdr
from macs_zenoh.protocol.rmw_zenoh.graph import Graph
from macs_zenoh.protocol.rmw_zenoh.keyexpr import (
    CPU_BACKENDS,
    Endpoint,
    Kind,
    Node,
    cpu_key,
    endpoint_token,
    every_token,
    node_token,
)
from macs_zenoh.protocol.rmw_zenoh.qos import SERVICES, Durability, History, Qos, Reliability

from .answers import all_answers
from .copies import copied
from .declared import Subscription
from .followed import Followed, OnToken
from .heartbeat import Heartbeat
from .leaving import leave
from .opening import open_session
from .panics import call, unwatched, watched
from .threads import keep_attached

log = logging.getLogger("macs.rmw_zenoh")

HEARTBEAT_S = 0.5
"""How long after a burst the last number of a reliable transient local publisher is told, as rmw_zenoh does."""
CALL_S = 600.0
"""How long a call may take unless it is given up here; rmw_zenoh's own."""
RESULT_S = 7 * 86_400.0
"""The same of the result of an action, for which rmw_zenoh has no limit."""
SETTINGS = ("timestamping/enabled:true",)

OnMessage = Callable[[bytes, Attachment], None]
OnChange = Callable[[Node | Endpoint, bool], None]
"""Hears of a node or an endpoint that has come, or gone."""


class NoCdr(UsageError):
    """What would be put on a robot's topic is no CDR; a ROS node that gets such a thing ends."""

    def __init__(self, topic: str) -> None:
        super().__init__(f"{topic}: what begins with no CDR header is never put on a topic of ROS")


class Request(NamedTuple):
    """A request to a service of ours, until it is answered."""

    cdr: bytes
    attached: Attachment
    query: zenoh.Query


class RosNetwork:
    """One session. Made by `open`; an async context manager.

    ``drops`` counts by name what was lost: ``bad_token`` (of a ROS node or endpoint), ``too_many_tokens``,
    ``bad_attachment`` (a message, request or reply whose attachment is none of rmw_zenoh's), ``bad_cdr`` (its payload
    is no CDR), ``bad_kind`` (a delete on a topic), ``foreign_reply`` (a reply to another request), ``failed`` (a
    callback failed, which is a fault of ours).
    """

    def __init__(self, session: zenoh.Session, settings: MeshSettings) -> None:
        self.settings = settings
        self.drops = Losses(log)
        self.session = watched(session)
        self.zid = str(session.zid())
        self.ids = itertools.count()
        self._lock = threading.Lock()
        self._graphs: dict[int, Graph] = {}
        self._watching: dict[int, Handle | Subscription] = {}
        self._on_change: Callbacks[OnChange] = Callbacks()
        self.linked = True
        """Whether a router is connected now. Set in Zenoh's thread, before the tokens behind it are taken for gone."""
        self.losses = 0
        """How often the only router was lost."""
        self.is_router = settings.mode == "router"
        self._links: set[str] = set()
        followed = zenoh.handlers.Callback(self._link, indirect=False)
        self._following = session.info.declare_link_events_listener(followed, history=True)

    @classmethod
    async def open(cls, settings: MeshSettings, *, on_waiting: Callable[[str], None] | None = None) -> RosNetwork:
        """Join as `Mesh.open` does, in the namespace of ``settings``, which for ROS is the session's.

        Raises ConfigError, Unreachable.
        """
        settings = structs.replace(settings, overrides=[*SETTINGS, *settings.overrides])
        return cls(await open_session(settings, on_waiting=on_waiting), settings)

    async def __aenter__(self) -> RosNetwork:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Leave; tokens end. A process must not exit without it."""
        for watching in self._watching.values():
            watching.close()
        await leave(self.session.close)

    def _link(self, event: zenoh.LinkEvent) -> None:
        keep_attached()
        with self._lock:
            name = f"{event.link.zid} {event.link.dst}"
            (self._links.add if event.kind == zenoh.SampleKind.PUT else self._links.discard)(name)
            before, self.linked = self.linked, bool(self._links) or self.is_router
            self.losses += before and not self.linked

    # -- the graph -----------------------------------------------------------------------------------------------

    def graph(self, domain: int) -> Graph:
        """The nodes and endpoints of a domain; from the first time on it is followed. From any thread."""
        with self._lock:
            graph = self._graphs.get(domain)
            if graph is not None:
                return graph
            graph = self._graphs[domain] = Graph(self.zid)
        receive = partial(self._token, graph)
        self._watching[domain] = self.watch_tokens(domain, receive)
        return graph

    async def known(self, domain: int, *, timeout_s: float = 2.0) -> None:
        """Follow the graph of a domain, unless it is followed already: the tokens that exist now are in it when this
        returns."""
        with self._lock:
            if domain in self._graphs:
                return
            graph = self._graphs[domain] = Graph(self.zid)
        self._watching[domain] = await self.follow_tokens(domain, partial(self._token, graph), timeout_s=timeout_s)

    async def tokens(self, domain: int | None, *, timeout_s: float = 2.0) -> list[str]:
        """The tokens of a domain, or of all, that exist now."""
        key, liveliness = every_token(domain), self.session.liveliness()
        found = await all_answers(lambda replies: liveliness.get(key, replies, timeout=timeout_s))
        return [str(token.key_expr) for token in found]

    async def follow_tokens(self, domain: int | None, receive: OnToken, *, timeout_s: float = 2.0) -> Handle:
        """Call ``receive(token, alive)``, from any thread, for each token of a domain, or of all, until the handle is
        closed; those that exist now have been told of when this returns."""
        followed = Followed(await self.tokens(domain, timeout_s=timeout_s), receive)
        watching = self.watch_tokens(domain, followed.told)
        confirming = asyncio.ensure_future(followed.confirm(partial(self.tokens, domain, timeout_s=timeout_s)))

        def end() -> None:
            confirming.cancel()
            watching.close()

        return Handle(end)

    def watch_tokens(self, domain: int | None, receive: OnToken) -> Subscription:
        """Call ``receive(token, alive)`` for each token of a domain, or of all."""

        def on_sample(sample: zenoh.Sample) -> None:
            keep_attached()
            receive(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        callback = zenoh.handlers.Callback(on_sample, indirect=False)
        return Subscription(self.session.liveliness().declare_subscriber(every_token(domain), callback, history=True))

    def on_change(self, callback: OnChange) -> Handle:
        """Call back for whoever comes and goes in the graphs that are followed."""
        return self._on_change.add(callback)

    def _token(self, graph: Graph, token: str, alive: bool) -> None:
        with self._lock:
            malformed, overflow = graph.malformed, graph.overflow
            found = graph.put(token) if alive else graph.delete(token)
        if graph.malformed != malformed:
            self.drops.note("bad_token", "", f"{token[:120]!r} is no token of a ROS node")
        if graph.overflow != overflow:
            self.drops.note("too_many_tokens", "", f"a graph of more than {len(graph)} tokens")
        if found is not None:
            for told in self._on_change:
                self.guarded(told, found, alive)

    def guarded(self, callback: Callable[..., None], *args: Any) -> None:
        """One callback that fails must not end the others."""
        try:
            callback(*args)
        except Exception:
            self.drops["failed"] += 1
            log.exception("a callback failed")

    def node(self, domain: int, name: str, namespace: str = "/") -> RosNode:
        """Be a node."""
        nid = next(self.ids)
        return RosNode(self, Node(domain, self.zid, nid, "/", namespace, name))


class RosNode:
    """A ROS node of ours."""

    def __init__(self, network: RosNetwork, node: Node) -> None:
        self.network = network
        self.node = node
        self.graph = network.graph(node.domain)
        self._token = Subscription(network.session.liveliness().declare_token(node_token(node)))

    def close(self) -> None:
        """Be it no more; what it has made is closed by who has it."""
        self._token.close()

    def endpoint(self, kind: Kind, topic: str, of_type: str, type_hash: str, qos: Qos, *more: str) -> Endpoint:
        """An endpoint of this node, with a number of its own."""
        return Endpoint(self.node, next(self.network.ids), kind, topic, of_type, type_hash, qos, more)

    def publisher(self, topic: str, of_type: str, type_hash: str, qos: Qos) -> RosPublisher:
        """Publish. Raises BadName, MissingExtra."""
        return RosPublisher(self.network, self.endpoint(Kind.PUBLISHER, topic, of_type, type_hash, qos))

    def subscription(
        self, topic: str, of_type: str, type_hash: str, qos: Qos, on_message: OnMessage, *, buffers: bool = False
    ) -> RosSubscription:
        """Subscribe. ``buffers``: also take what a publisher of Lyrical puts beside the topic. Raises BadName."""
        more = (CPU_BACKENDS,) if buffers and qos.durability != Durability.TRANSIENT_LOCAL else ()
        endpoint = self.endpoint(Kind.SUBSCRIPTION, topic, of_type, type_hash, qos, *more)
        return RosSubscription(self.network, endpoint, on_message)

    def service(self, name: str, of_type: str, type_hash: str, on_request: Callable[[Request], None]) -> RosService:
        """Have a service. Raises BadName."""
        endpoint = self.endpoint(Kind.SERVICE, name, of_type, type_hash, SERVICES)
        return RosService(self.network, endpoint, on_request)

    def client(self, name: str, of_type: str, type_hash: str, *, timeout_s: float = CALL_S) -> RosClient:
        """Call a service. Raises BadName, MissingExtra."""
        return RosClient(self.network, self.endpoint(Kind.CLIENT, name, of_type, type_hash, SERVICES), timeout_s)


class RosPublisher:
    """Puts messages, numbered, with a GID that is the token's."""

    def __init__(self, network: RosNetwork, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        token = endpoint_token(endpoint)
        self.gid = gid_of(token)
        self._numbers = itertools.count(1)
        self._lock = threading.Lock()
        self._heartbeat: Heartbeat | None = None
        qos, reliable = endpoint.qos, endpoint.qos.reliability != Reliability.BEST_EFFORT
        waits = reliable and qos.history == History.KEEP_ALL
        options: dict[str, Any] = {
            "congestion_control": zenoh.CongestionControl.BLOCK if waits else zenoh.CongestionControl.DROP,
            "priority": zenoh.Priority.DATA,
            "express": False,
            "reliability": zenoh.Reliability.RELIABLE if reliable else zenoh.Reliability.BEST_EFFORT,
        }
        if qos.durability == Durability.TRANSIENT_LOCAL:
            if reliable:  # numbered; the heartbeat is ours
                options["sample_miss_detection"] = zenoh.ext.MissDetectionConfig(
                    heartbeat=None, sporadic_heartbeat=None
                )
            self._publisher = call(
                zenoh.ext.declare_advanced_publisher,
                unwatched(network.session),
                endpoint.key,
                cache=zenoh.ext.CacheConfig(max(1, qos.depth)),
                publisher_detection=True,
                **options,
            )
            if reliable:
                self._heartbeat = Heartbeat(network.session, endpoint.key, self._publisher, HEARTBEAT_S)
        else:
            self._publisher = network.session.declare_publisher(endpoint.key, **options)
        told = [self._heartbeat] if self._heartbeat is not None else []
        self._declared = Subscription(*told, self._publisher, network.session.liveliness().declare_token(token))

    def publish(self, cdr: bytes) -> None:
        """Put a message. From any thread. Raises NoCdr."""
        if not looks_like_cdr(cdr):
            raise NoCdr(self.endpoint.topic)
        with self._lock:  # numbers go out in their order
            number = next(self._numbers)
            attached = encode_attachment(number, time.time_ns(), self.gid)
            call(self._publisher.put, cdr, attachment=attached)
            if self._heartbeat is not None:
                self._heartbeat.note(number - 1)  # Zenoh counts from 0

    def close(self) -> None:
        """Publish no more."""
        self._declared.close()


class RosSubscription:
    """Takes messages; of a transient local topic also those that publishers hold, and what was missed."""

    def __init__(self, network: RosNetwork, endpoint: Endpoint, on_message: OnMessage) -> None:
        self.endpoint = endpoint
        self._network = network
        self._on_message = on_message
        session, qos = network.session, endpoint.qos
        callback = zenoh.handlers.Callback(self._receive, indirect=False)
        if qos.durability == Durability.TRANSIENT_LOCAL:
            reliable = qos.reliability != Reliability.BEST_EFFORT
            subscriber: Any = call(
                zenoh.ext.declare_advanced_subscriber,
                unwatched(session),
                endpoint.key,
                callback,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=max(1, qos.depth)),
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True) if reliable else None,
                subscriber_detection=True,
            )
        else:
            subscriber = session.declare_subscriber(endpoint.key, callback)
        declared = [subscriber]
        if endpoint.takes_cpu_buffers:
            beside = zenoh.handlers.Callback(self._receive, indirect=False)
            declared.append(session.declare_subscriber(cpu_key(endpoint.key), beside))
        # the token last: who reads it puts at once
        self._declared = Subscription(*declared, session.liveliness().declare_token(endpoint_token(endpoint)))

    def _receive(self, sample: zenoh.Sample) -> None:
        keep_attached()
        drops, topic = self._network.drops, self.endpoint.topic
        if sample.kind != zenoh.SampleKind.PUT:
            drops.note("bad_kind", topic, "a delete, which ROS does not have")
            return
        attached = parse_attachment(sample.attachment.to_bytes()) if sample.attachment is not None else None
        if attached is None:
            drops.note("bad_attachment", topic, "a message whose attachment is none of rmw_zenoh's")
            return
        cdr = copied(sample.payload)
        if not looks_like_cdr(cdr):
            drops.note("bad_cdr", topic, "a message that begins with no CDR header")
            return
        self._network.guarded(self._on_message, cdr, attached)

    def close(self) -> None:
        """Subscribe no more."""
        self._declared.close()


class RosService:
    """Answers requests."""

    def __init__(self, network: RosNetwork, endpoint: Endpoint, on_request: Callable[[Request], None]) -> None:
        self.endpoint = endpoint
        self._network = network
        self._on_request = on_request
        session = network.session
        asked = zenoh.handlers.Callback(self._asked, indirect=False)
        self._declared = Subscription(
            session.declare_queryable(endpoint.key, asked, complete=True),
            session.liveliness().declare_token(endpoint_token(endpoint)),
        )

    def _asked(self, query: zenoh.Query) -> None:
        keep_attached()
        attached = parse_attachment(query.attachment.to_bytes()) if query.attachment is not None else None
        cdr = copied(query.payload) if query.payload is not None else b""
        drops, name = self._network.drops, self.endpoint.topic
        if attached is None:
            drops.note("bad_attachment", name, "a request whose attachment is none of rmw_zenoh's")
        elif not looks_like_cdr(cdr):
            drops.note("bad_cdr", name, "a request that begins with no CDR header")
        else:
            self._network.guarded(self._on_request, Request(cdr, attached, query))
            return
        query.drop()  # type: ignore[no-untyped-call]

    def answer(self, request: Request, cdr: bytes) -> None:
        """Answer a request, once. From any thread. Raises NoCdr."""
        if not looks_like_cdr(cdr):
            raise NoCdr(self.endpoint.topic)
        number, _, gid = request.attached
        with request.query as query:
            call(
                query.reply,
                self.endpoint.key,
                cdr,
                attachment=encode_attachment(number, time.time_ns(), gid),
                congestion_control=zenoh.CongestionControl.BLOCK,
            )

    def close(self) -> None:
        """Answer no more."""
        self._declared.close()


class RosClient:
    """Asks a service."""

    def __init__(self, network: RosNetwork, endpoint: Endpoint, timeout_s: float) -> None:
        self.endpoint = endpoint
        self._network = network
        token = endpoint_token(endpoint)
        self.gid = gid_of(token)
        self._numbers = itertools.count(1)
        session = network.session
        self._querier = session.declare_querier(
            endpoint.key,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            congestion_control=zenoh.CongestionControl.BLOCK,
            timeout=timeout_s,
        )
        self._declared = Subscription(self._querier, session.liveliness().declare_token(token))

    def is_ready(self) -> bool:
        """Whether somebody has the service. From any thread."""
        own = self.endpoint
        servers = self._network.graph(own.node.domain).on(own.topic, Kind.SERVICE)
        return any((server.type, server.hash) == (own.type, own.hash) for server in servers)

    def call(self, request: bytes, done: Callable[[bytes | None, str], None]) -> Callable[[], None]:
        """Ask. ``done`` gets the first response, or None and why there is none, once. Returns what gives the call up.
        From any thread. Raises NoCdr."""
        if not looks_like_cdr(request):
            raise NoCdr(self.endpoint.topic)
        number = next(self._numbers)
        lock = threading.Lock()
        answered: list[bool] = []

        def settle(response: bytes | None, problem: str) -> None:
            with lock:
                if answered:
                    return
                answered.append(True)
            self._network.guarded(done, response, problem)

        giving_up = zenoh.CancellationToken()

        def replied(reply: zenoh.Reply) -> None:
            self._replied(reply, number, settle)

        def ended() -> None:
            settle(None, f"{self.endpoint.topic} did not answer")

        call(
            self._querier.get,
            zenoh.handlers.Callback(replied, ended, indirect=False),
            payload=request,
            attachment=encode_attachment(number, time.time_ns(), self.gid),
            cancellation_token=giving_up,
        )

        def forget() -> None:
            with lock:
                if answered:
                    return
                answered.append(True)
            giving_up.cancel()

        return forget

    def _replied(self, reply: zenoh.Reply, number: int, settle: Callable[[bytes | None, str], None]) -> None:
        keep_attached()
        drops, name = self._network.drops, self.endpoint.topic
        if (ok := reply.ok) is None:
            settle(None, f"{name} answered with an error")
            return
        attached = parse_attachment(ok.attachment.to_bytes()) if ok.attachment is not None else None
        cdr = ok.payload.to_bytes()
        if attached is None:
            drops.note("bad_attachment", name, "a reply whose attachment is none of rmw_zenoh's")
        elif attached.number != number:
            drops.note("foreign_reply", name, "a reply to another request")
        elif not looks_like_cdr(cdr):
            drops.note("bad_cdr", name, "a reply that begins with no CDR header")
        else:
            settle(cdr, "")

    def close(self) -> None:
        """Ask no more."""
        self._declared.close()
