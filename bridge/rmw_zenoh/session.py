"""The ROS side of a robot on the keys of ROS 2's own Zenoh middleware: `bridge.ros.side`, with no ROS installed."""

from __future__ import annotations

import asyncio
import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection
from concurrent.futures import Future, wait
from contextlib import ExitStack
from functools import partial
from typing import Any, TypeVar

from bridge.rmw_zenoh.ends import Held, Typed, ZenohClient, ZenohPublisher, ZenohServer, ZenohSubscription
from bridge.rmw_zenoh.goals import ZenohGoals
from bridge.rmw_zenoh.places import is_within
from bridge.rmw_zenoh.types import DESCRIPTION, KnownMessage, KnownTypes
from bridge.ros.alarms import Alarms
from bridge.ros.jobs import settle
from bridge.ros.side import (
    ActionType,
    Client,
    Events,
    Found,
    MessageType,
    NamesAndTypes,
    OnRaw,
    Other,
    Publisher,
    Server,
    ServiceType,
)
from bridge.ros.types import InterfaceName
from macs_zenoh.errors import Refused, Unreachable
from macs_zenoh.mesh.ros_network import RosNetwork
from macs_zenoh.protocol.rmw_zenoh.keyexpr import (
    HASH_NOT_SUPPORTED,
    NO_HASH,
    BadName,
    Endpoint,
    Kind,
    Node,
    check_name,
)
from macs_zenoh.protocol.rmw_zenoh.qos import Qos
from macs_zenoh.protocol.schemas import Definition
from macs_zenoh.typed import part_of_action, request_of, response_of

log = logging.getLogger("macs.ros")

T = TypeVar("T")

DESCRIBE_S = 1.0
"""How long nodes may take to describe a type."""
DESCRIBERS = 4
"""So many nodes are asked at once."""
SILENT_S = 30.0
"""A node that did not answer is not asked again for so long."""


class ZenohSession:
    """A node of ours on a ROS graph, until `close`. The ROS thread is one that nothing else waits for."""

    def __init__(
        self,
        network: RosNetwork,
        types: KnownTypes,
        *,
        domain: int = 0,
        namespace: str = "/",
        name: str = "rosagent",
        own_names: Collection[str] = (),
    ) -> None:
        """``namespace``: of the robot's nodes; what others have beside it is no part of the robot. ``own_names`` are
        in it as well, as the topic of the emergency stop: robots that share a domain have each its own."""
        self.network = network
        self.types = types
        self._namespace = namespace
        self._remapped = {name: namespace + name for name in own_names} if namespace != "/" else {}
        self.node = network.node(domain, name, namespace)
        self.graph = self.node.graph
        self._work = Alarms()
        self._urgent = Alarms()
        self._open = True
        self._lock = threading.Lock()
        self._jobs: set[Future[Any]] = set()
        self._hurried: set[Future[Any]] = set()
        self._held: list[Held] = []
        self._silent: dict[Endpoint, float] = {}
        """Nodes that did not describe a type, and until when they are not asked again."""
        self._watching = network.on_change(self._changed)

    @property
    def domain(self) -> int:
        """`Side.domain`."""
        return self.node.node.domain

    beside = "over rmw_zenoh; when the network to the robot parts nobody stops it"
    """`Side.beside`."""

    @property
    def full_name(self) -> str:
        """`Side.full_name`."""
        return self.node.node.full_name

    # -- the ROS thread ------------------------------------------------------------------------------------------

    def submit(self, job: Callable[[], T]) -> Future[T]:
        """`Side.submit`."""
        return self._submitted(job, self._work)

    def hurry(self, job: Callable[[], T]) -> Future[T]:
        """`Side.hurry`: in a thread of its own, as the ROS thread may wait for a robot's node."""
        return self._submitted(job, self._urgent)

    def _submitted(self, job: Callable[[], T], thread: Alarms) -> Future[T]:
        future: Future[T] = Future()
        with self._lock:
            if not self._open:
                future.set_exception(Unreachable("the ROS graph", "the session is closed"))
                return future
            before = [*self._hurried]
            self._jobs.add(future)
            if thread is self._urgent:
                self._hurried.add(future)
        future.add_done_callback(self._done)
        thread.at(time.monotonic(), lambda: self._do(job, future, before))
        return future

    def _do(self, job: Callable[[], T], future: Future[T], before: list[Future[Any]]) -> None:
        wait(before, timeout=DESCRIBE_S)  # what ends something comes after what uses it
        with self._lock:
            self._jobs.discard(future)
        settle(future, job)

    def _done(self, future: Future[Any]) -> None:
        with self._lock:
            self._hurried.discard(future)

    def later(self, delay_s: float, job: Callable[[], object], *, hurry: bool = False) -> None:
        """`Side.later`; ``hurry``: also while the ROS thread waits."""

        def do() -> None:
            job()

        (self._urgent if hurry else self._work).at(time.monotonic() + delay_s, do)

    async def run(self, job: Callable[[], T]) -> T:
        """`Side.run`."""
        return await asyncio.wrap_future(self.submit(job))

    def close(self) -> None:
        """Leave the graph: what was submitted before is done first."""
        self._watching.close()
        with self._lock:
            waiting = [*self._jobs, *self._hurried]
        wait(waiting, timeout=DESCRIBE_S)
        with self._lock:
            self._open = False
            unfinished = [*self._jobs]
        self._work.close()
        self._urgent.close()
        for future in unfinished:
            if future.set_running_or_notify_cancel():
                future.set_exception(Unreachable("the ROS graph", "the session is closed"))
        for held in [*self._held]:
            held.close()
        self.node.close()

    # -- names ---------------------------------------------------------------------------------------------------

    def topic_name(self, name: str) -> str:
        """`Side.topic_name`."""
        own = self.node.node
        if name.startswith("~"):
            full = own.full_name + name[1:]
        else:
            full = name if name.startswith("/") else f"{own.namespace.rstrip('/')}/{name}"
        try:
            return check_name(self._remapped.get(full, full))
        except BadName as error:
            raise Refused(f"{name[:80]!r} cannot be used on this robot: {error}") from error

    def service_name(self, name: str) -> str:
        """`Side.service_name`."""
        return self.topic_name(name)

    # -- the graph -----------------------------------------------------------------------------------------------

    def topics(self) -> NamesAndTypes:
        """`Side.topics`."""
        return self.graph.names_and_types(Kind.PUBLISHER, Kind.SUBSCRIPTION)

    def services(self) -> NamesAndTypes:
        """`Side.services`."""
        return self.graph.names_and_types(Kind.SERVICE)

    def publishers(self, topic: str) -> list[Other]:
        """`Side.publishers`."""
        return list(map(_other, self.graph.on(topic, Kind.PUBLISHER)))

    def subscriptions(self, topic: str) -> list[Other]:
        """`Side.subscriptions`."""
        return list(map(_other, self.graph.on(topic, Kind.SUBSCRIPTION)))

    def count_publishers(self, topic: str) -> int:
        """`Side.count_publishers`."""
        return len(self.graph.on(topic, Kind.PUBLISHER))

    def count_servers(self, service: str) -> int:
        """`Side.count_servers`."""
        return len(self.graph.on(service, Kind.SERVICE))

    def servers_elsewhere(self, service: str) -> list[str]:
        """`Side.servers_elsewhere`."""
        return sorted({server.node.full_name for server in self.graph.on(service, Kind.SERVICE, others=True)})

    def found(self) -> Found:
        """`Side.found`, as far as the nodes are the robot's."""

        def of(kind: Kind) -> dict[str, str]:
            found: dict[str, str] = {}
            for endpoint in self.graph.endpoints(kind, others=True):
                if endpoint.type and is_within(self._namespace, endpoint.node):
                    found[endpoint.topic] = min(endpoint.type, found.get(endpoint.topic, endpoint.type))
            return found

        return Found(of(Kind.SUBSCRIPTION), of(Kind.PUBLISHER), of(Kind.SERVICE))

    # -- types ---------------------------------------------------------------------------------------------------

    def definition(self, name: InterfaceName) -> Definition:
        """`Side.definition`. What this robot has under that name is what it is in ROS, as far as it is known here."""
        return self.types.definition(str(name))

    def message(self, name: InterfaceName, topic: str = "") -> MessageType:
        """`Side.message`."""
        self.hash_of(topic, str(name))  # that there is one
        return Typed(str(name), self._type(str(name), str(name), topic))

    def service(self, name: InterfaceName, topic: str = "") -> ServiceType:
        """`Side.service`."""
        full = str(name)
        self.hash_of(topic, full)
        return ServiceType(self._type(full, request_of(full), topic), self._type(full, response_of(full), topic), full)

    def action(self, name: InterfaceName, topic: str = "") -> ActionType:
        """`Side.action`. Its results cannot be passed on without a definition."""
        full, part = str(name), f"{topic}/_action"
        goal = self._type(f"{full}_SendGoal", part_of_action(full, "Goal"), f"{part}/send_goal")
        result = self._type(f"{full}_GetResult", part_of_action(full, "Result"), f"{part}/get_result")
        if not isinstance(result, KnownMessage):
            raise Refused(f"the definition of {full} is not known here, and no node of the robot describes it")
        return ActionType(goal, (full, result.shape))

    def _type(self, name: str, part: str, topic: str) -> MessageType:
        known = self._known_hash(topic, name)
        return self.types.message(name, part, known or "", lambda *asked: self._describe(topic, *asked))

    def hash_of(self, topic: str, name: str) -> str:
        """The hash of a type on a topic: as others there have it, else by its definition. Raises Refused."""
        found = self._known_hash(topic, name)
        if found is None and any(one.hash == HASH_NOT_SUPPORTED for one in self.graph.endpoints(others=True)):
            found = HASH_NOT_SUPPORTED  # a robot that knows no hashes
        found = found or self.types.hash_of(name)
        if found is None:
            raise Refused(f"type {name} is not known here, and nothing on this robot has it as {topic}")
        return found

    def _known_hash(self, topic: str, name: str) -> str | None:
        there = self.graph.on(topic, others=True)
        hashes = Counter(one.hash for one in there if one.type == name and one.hash != NO_HASH)
        return hashes.most_common(1)[0][0] if hashes else None

    def _describe(self, topic: str, name: str, type_hash: str, request: bytes) -> bytes | None:
        """Ask the nodes that have a topic what its type consists of. In the ROS thread, which waits for them: for all
        together, and for who did not answer not again for a while."""
        now, nodes = time.monotonic(), dict.fromkeys(one.node for one in self.graph.on(topic, others=True))
        self._silent = {server: until for server, until in self._silent.items() if until > now}
        names = [f"{node.full_name}/get_type_description" for node in nodes]
        servers = [one for each in names for one in self.graph.on(each, Kind.SERVICE, others=True)]
        return self._asked([server for server in servers if server not in self._silent][:DESCRIBERS], request)

    def _asked(self, servers: list[Endpoint], request: bytes) -> bytes | None:
        """The first answer of these."""
        answers: queue.SimpleQueue[tuple[Endpoint, bytes | None]] = queue.SimpleQueue()
        until, waiting = time.monotonic() + DESCRIBE_S, set(servers)
        with ExitStack() as stack:
            for server in servers:
                client = self.node.client(server.topic, DESCRIPTION, server.hash, timeout_s=2 * DESCRIBE_S)
                stack.callback(client.close)
                stack.callback(client.call(request, partial(_put, answers, server)))
            while waiting:
                try:
                    server, response = answers.get(timeout=max(0.0, until - time.monotonic()))
                except queue.Empty:
                    self._silent.update(dict.fromkeys(waiting, until + SILENT_S))
                    break
                if response is not None:
                    return response
                waiting.discard(server)
        return None

    # -- our ends ------------------------------------------------------------------------------------------------

    def subscribe(
        self, of: MessageType, topic: str, on_raw: OnRaw, qos: Qos, events: Events | None = None
    ) -> ZenohSubscription:
        """`Side.subscribe`."""
        assert isinstance(of, Typed)
        return ZenohSubscription(self, of, self.topic_name(topic), on_raw, qos, events or Events())

    def advertise(
        self, of: MessageType, topic: str, qos: Qos, matched: Callable[[int], None] | None = None
    ) -> Publisher:
        """`Side.advertise`."""
        assert isinstance(of, Typed)
        return ZenohPublisher(self, of, self.topic_name(topic), qos, matched or (lambda count: None))

    def client(self, of: ServiceType, service: str) -> Client:
        """`Side.client`."""
        return ZenohClient(self, of.own, self.service_name(service))

    def serve(self, of: ServiceType, service: str, on_request: Callable[[bytes, Any], None]) -> Server:
        """`Side.serve`."""
        return ZenohServer(self, of.own, self.service_name(service), on_request)

    def goals(self, of: ActionType, action: str) -> ZenohGoals:
        """`Side.goals`."""
        name, result = of.own
        return ZenohGoals(self, name, self.topic_name(action), result)

    def hold(self, held: Held) -> None:
        """It follows the graph from now on."""
        self._held.append(held)

    def let_go(self, held: Held) -> None:
        """It does no more."""
        if held in self._held:
            self._held.remove(held)

    # -- in Zenoh's threads --------------------------------------------------------------------------------------

    def _changed(self, found: Node | Endpoint, alive: bool) -> None:
        if isinstance(found, Endpoint) and found.node.domain == self.domain:
            for held in [*self._held]:
                if held.topic == found.topic:
                    held.changed(found, alive)


def _put(
    answers: queue.SimpleQueue[tuple[Endpoint, bytes | None]], server: Endpoint, response: bytes | None, _why: str
) -> None:
    answers.put((server, response))


def _other(endpoint: Endpoint) -> Other:
    return Other(endpoint.node.full_name, endpoint.type, endpoint.qos)
