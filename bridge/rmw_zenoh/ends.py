"""What a node of ours has on a ROS graph without ROS: publishers, subscriptions, services and clients."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from bridge.ros.side import CutOff, Events, MessageType, OnRaw, first_line
from macs_zenoh.mesh.ros_network import CALL_S, Request, RosClient, RosPublisher, RosService, RosSubscription
from macs_zenoh.protocol.rmw_zenoh.attachment import Attachment
from macs_zenoh.protocol.rmw_zenoh.keyexpr import NO_HASH, Endpoint, Kind
from macs_zenoh.protocol.rmw_zenoh.qos import Durability, Qos

if TYPE_CHECKING:
    from bridge.rmw_zenoh.session import ZenohSession

log = logging.getLogger("macs.ros")

T = TypeVar("T")

AGAIN_S = 1.0
"""After so long what could not be had is tried again."""


class Entity(Protocol):
    """What a node of ours has on the graph."""

    endpoint: Endpoint

    def close(self) -> None:
        """Have it no more."""


class Held:
    """Something of ours on the graph that has the hash of its type as others have it: it is made again when theirs is
    another one, as after an update of the robot."""

    def __init__(self, session: ZenohSession, topic: str, of_type: str) -> None:
        self.session = session
        self.topic = topic
        self.type = of_type
        self._lock = threading.Lock()
        self._closed = self._trying = False
        self._problem = ""
        self.entity: Any = self.make(session.hash_of(topic, of_type))
        session.hold(self)

    def make(self, type_hash: str) -> Entity:
        """Have it, with this hash."""
        raise NotImplementedError

    def changed(self, found: Endpoint, alive: bool) -> None:
        """Somebody else's end has come or gone."""
        foreign = found.type == self.type and found.node.zid != self.session.graph.own
        if alive and foreign and found.hash not in (self.entity.endpoint.hash, NO_HASH):
            self.session.submit(self._follow)

    def _follow(self) -> None:
        """What is had until then stays until the other is there, and when that cannot be had now: what a robot is
        stopped by may be published at any moment."""
        there = self.session.graph.on(self.topic, others=True)
        hashes = {one.hash for one in there if one.type == self.type}
        with self._lock:
            if self._closed or not hashes or self.entity.endpoint.hash in hashes:
                return
            made: Any = None
            try:
                made = self.make(self.session.hash_of(self.topic, self.type))
                self.take_over(made)
            except Exception as error:  # noqa: BLE001 - Zenoh's, whatever it is
                if made is not None:
                    made.close()
                self._try_again(first_line(error))
                return
            log.info("%s: its type %s has another hash on this robot now", self.topic, self.type)
            old, self.entity, self._problem = self.entity, made, ""
            old.close()

    def take_over(self, made: Any) -> None:
        """What nobody uses yet has from now on what the one before it had."""

    def _try_again(self, problem: str) -> None:
        if problem != self._problem:
            self._problem = problem
            log.warning("%s: its type %s has another hash now, but %s", self.topic, self.type, problem)
        if self._trying:
            return
        self._trying = True

        def follow() -> None:
            self._trying = False
            self._follow()

        self.session.later(AGAIN_S, follow)

    def use(self, do: Callable[[Any], T]) -> T:
        """Do something with the entity, in any thread: again, when it is another one meanwhile."""
        entity = self.entity
        try:
            return do(entity)
        except Exception:
            if entity is self.entity:
                raise
            return do(self.entity)

    def close(self) -> None:
        """Have it no more."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self.session.let_go(self)
                self.entity.close()


class ZenohSubscription(Held):
    """Ours, of a topic."""

    def __init__(self, session: ZenohSession, of: Typed, topic: str, on_raw: OnRaw, qos: Qos, events: Events) -> None:
        self._on_raw = on_raw
        self._qos = qos
        self._events = events
        self._count = 0
        super().__init__(session, topic, of.name)
        self._tell()

    def make(self, type_hash: str) -> RosSubscription:
        buffers = any(one.more for one in self.session.graph.endpoints(Kind.SUBSCRIPTION, others=True))
        node = self.session.node
        return node.subscription(self.topic, self.type, type_hash, self._qos, self._take, buffers=buffers)

    def _take(self, cdr: bytes, attached: Attachment) -> None:
        info = {"source_timestamp": attached.time_ns, "publication_sequence_number": attached.number}
        self._on_raw(cdr, info)

    def changed(self, found: Endpoint, alive: bool) -> None:
        super().changed(found, alive)
        if found.kind is Kind.PUBLISHER:
            self._tell()

    def _tell(self) -> None:
        count = self.session.count_publishers(self.topic)
        before, self._count = self._count, count
        if count != before:
            self._events.matched(count, count - before)


class ZenohPublisher(Held):
    """Ours, on a topic."""

    def __init__(self, session: ZenohSession, of: Typed, topic: str, qos: Qos, matched: Callable[[int], None]) -> None:
        self._qos = qos
        self._matched = matched
        latched = qos.durability is Durability.TRANSIENT_LOCAL
        self._held: deque[bytes] | None = deque(maxlen=max(1, qos.depth)) if latched else None
        """What nodes hear that come later."""
        self._waits = False
        """Whether nodes that took this were cut off, and none is back."""
        super().__init__(session, topic, of.name)
        self._tell()

    def make(self, type_hash: str) -> RosPublisher:
        return self.session.node.publisher(self.topic, self.type, type_hash, self._qos)

    def publish(self, cdr: bytes) -> None:
        """`Publisher.publish`. What is latched waits for nodes that are cut off, nothing else does."""
        if self._held is None:
            if self._waits or not self.session.network.linked:
                raise CutOff("the way to the router of its nodes is lost")
            self.use(lambda entity: entity.publish(cdr))
            return
        with self._lock:  # what is latched is told in its order, by whichever entity
            self.entity.publish(cdr)
            self._held.append(cdr)

    def take_over(self, made: Any) -> None:
        for cdr in self._held or ():
            made.publish(cdr)

    def changed(self, found: Endpoint, alive: bool) -> None:
        super().changed(found, alive)
        if found.kind is Kind.SUBSCRIPTION:
            if found.node.zid != self.session.graph.own:
                self._waits = not alive and (self._waits or not self.session.network.linked)
            self._tell()

    def _tell(self) -> None:
        self._matched(len(self.session.graph.on(self.topic, Kind.SUBSCRIPTION)))


class ZenohClient(Held):
    """Ours, of a service."""

    def __init__(self, session: ZenohSession, of_type: str, service: str, timeout_s: float = CALL_S) -> None:
        self._timeout_s = timeout_s
        super().__init__(session, service, of_type)

    def make(self, type_hash: str) -> RosClient:
        return self.session.node.client(self.topic, self.type, type_hash, timeout_s=self._timeout_s)

    def is_ready(self) -> bool:
        """`Client.is_ready`."""
        return bool(self.entity.is_ready())

    def call(self, request: bytes, done: Callable[[bytes | None, str], None]) -> Callable[[], None]:
        """`Client.call`."""
        forget: Callable[[], None] = self.use(lambda entity: entity.call(request, done))
        return forget


class ZenohServer(Held):
    """Ours: a service."""

    def __init__(
        self, session: ZenohSession, of_type: str, service: str, on_request: Callable[[bytes, Any], None]
    ) -> None:
        self._on_request = on_request
        super().__init__(session, service, of_type)

    def make(self, type_hash: str) -> RosService:
        return self.session.node.service(self.topic, self.type, type_hash, self._asked)

    def _asked(self, request: Request) -> None:
        self._on_request(request.cdr, request)

    def answer(self, header: Any, response: bytes) -> None:
        """`Server.answer`."""
        self.entity.answer(header, response)


class Typed(MessageType):
    """A message's type, with its name."""

    def __init__(self, name: str, of: MessageType) -> None:
        self.name = name
        self.least_bytes, self.unity, self.parts = of.least_bytes, of.unity, of.parts
        self.problem = of.problem  # type: ignore[method-assign]
        self.filled = of.filled  # type: ignore[method-assign]
        self.failure = of.failure  # type: ignore[method-assign]
