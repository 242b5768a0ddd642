"""A Python program as a ROS node, without ROS: on a router with nodes that run ROS 2's own Zenoh middleware. Asyncio.

::

    async with macs_zenoh.ros.node("battery", connect=["tcp/127.0.0.1:7447"]) as node:
        voltage = node.publisher("/voltage", "std_msgs/Float32")
        voltage.publish({"data": 24.1})
        async for message in node.subscribe("/chatter", "std_msgs/String"):
            print(message.value["data"])

``ros2 topic list`` shows it, with the domain and the router that it was given. Messages are Python values, read and
written by `typed`; CDR as bytes passes as it is. Needs ``pip install 'macs-zenoh[rmw-zenoh]'``. docs/rmw-zenoh.md.
"""

from __future__ import annotations

import asyncio
import logging
import re
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from .config import MeshSettings
from .errors import CallTimeout, Closed, Unreachable, UsageError
from .losses import Losses
from .mesh.ros_network import Request, RosClient, RosNetwork, RosNode, RosPublisher, RosService, RosSubscription
from .protocol.rmw_zenoh.attachment import Attachment
from .protocol.rmw_zenoh.keyexpr import HASH_NOT_SUPPORTED, NO_HASH, Kind, check_name
from .protocol.rmw_zenoh.qos import Durability, History, Qos, Reliability
from .sections import changed
from .timeouts import within
from .type_hashes import Hashes
from .typed import Types, UnknownType, request_of, response_of

__all__ = [
    "Durability",
    "History",
    "Kind",
    "Message",
    "Node",
    "Publisher",
    "Qos",
    "Reliability",
    "Service",
    "Subscription",
    "node",
]

log = logging.getLogger("macs.rmw_zenoh")

Value = Mapping[str, Any]
Handler = Callable[[dict[str, Any]], Awaitable[Value | bytes]]
"""Answers a request of a service, given as a Python value."""

_M = TypeVar("_M", bound="Publisher | Subscription | Service")

DEPTH = 10
"""As rclpy has it where nothing else is said."""
FOUND_S = 2.0
"""How long a call waits for a service that is not there, at most; at most half of its own time."""
LOOK_S = 0.01
ANSWER_S = 5.0

_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)


class Message:
    """A message of a topic. ``data`` is its CDR, ``time_ns`` when its publisher says that it was published."""

    __slots__ = ("_types", "data", "number", "time_ns", "topic", "type")

    def __init__(self, topic: str, of_type: str, data: bytes, attached: Attachment, types: Types) -> None:
        self.topic = topic
        self.type = of_type
        self.data = data
        self.time_ns = attached.time_ns
        self.number = attached.number
        self._types = types

    @property
    def value(self) -> dict[str, Any]:
        """As a Python value. Raises BadCdr, UnknownType."""
        return self._types.deserialize(self.type, self.data)


class Node:
    """A ROS node of this program. Made by `node`; all methods belong to its event loop.

    ``drops`` counts by name what was lost: ``inbox_full`` (messages came faster than they were taken; the oldest
    goes), and what the session lost (`mesh.ros_network`).
    """

    def __init__(self, network: RosNetwork, ros: RosNode, types: Types) -> None:
        self.network = network
        self.types = types
        self.drops: Losses = network.drops
        self._ros = ros
        self._hashes = Hashes(types)
        self._loop = asyncio.get_running_loop()
        self._clients: dict[tuple[str, str], RosClient] = {}
        self._made: list[Publisher | Subscription | Service] = []

    @property
    def full_name(self) -> str:
        """Namespace and name."""
        return self._ros.node.full_name

    def publisher(self, topic: str, type: str, *, qos: Qos | None = None) -> Publisher:  # noqa: A002 - as in ROS
        """Publish a topic: ``/pose``, or ``pose`` in the node's namespace.

        Raises UsageError: the name or the type is none, or nothing is known of the type.
        """
        name, full = self._name(topic), _type(type)
        made = self._ros.publisher(name, full, self._hash(name, full), qos or Qos(depth=DEPTH))
        return self._kept(Publisher(made, full, self.types))

    def subscribe(
        self,
        topic: str,
        type: str,  # noqa: A002 - as in ROS
        *,
        qos: Qos | None = None,
    ) -> Subscription:
        """Subscribe to a topic. With a transient local ``qos`` also to what its publishers hold. Raises UsageError."""
        name, full = self._name(topic), _type(type)
        return self._kept(Subscription(self, name, full, self._hash(name, full), qos or Qos(depth=DEPTH)))

    def serve(self, service: str, type: str, handler: Handler) -> Service:  # noqa: A002 - as in ROS
        """Have a service: ``handler(request)`` gives its response. One that fails has none. Raises UsageError."""
        name, full = self._name(service), _type(type, "srv")
        return self._kept(Service(self, name, full, self._hash(name, full), handler))

    async def call(
        self,
        service: str,
        type: str,  # noqa: A002 - as in ROS
        request: Value | bytes,
        *,
        timeout_s: float = ANSWER_S,
    ) -> Any:
        """Call a service: its response, as a Python value, or as CDR where the request was CDR.

        Raises Unreachable (there is no such service, or it has ended), CallTimeout, BadValue, UsageError.
        """
        name, full = self._name(service), _type(type, "srv")
        as_cdr = isinstance(request, bytes)
        cdr = request if isinstance(request, bytes) else self.types.serialize(request_of(full), request)
        client = self._client(name, full)
        loop = self._loop
        deadline = loop.time() + min(FOUND_S, timeout_s / 2)
        while not client.is_ready():
            if loop.time() > deadline:
                raise Unreachable(name, "there is no such service")
            await asyncio.sleep(LOOK_S)
        answer: asyncio.Future[bytes] = loop.create_future()

        def settle(response: bytes | None, problem: str) -> None:
            if answer.done():
                return
            if response is None:
                answer.set_exception(Unreachable(name, problem))
            else:
                answer.set_result(response)

        def done(response: bytes | None, problem: str) -> None:
            with suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(settle, response, problem)

        forget = client.call(cdr, done)
        try:
            response = await within(answer, timeout_s)
        except asyncio.TimeoutError:
            raise CallTimeout(name, timeout_s) from None
        finally:
            forget()
        return response if as_cdr else self.types.deserialize(response_of(full), response)

    def close(self) -> None:
        """End all that it has."""
        for made in [*self._made, *self._clients.values()]:
            made.close()
        self._made.clear()
        self._clients.clear()
        self._ros.close()

    def _client(self, name: str, full: str) -> RosClient:
        client = self._clients.get((name, full))
        if client is None:
            client = self._clients[name, full] = self._ros.client(name, full, self._hash(name, full))
        return client

    def _kept(self, made: _M) -> _M:
        self._made.append(made)
        return made

    def _name(self, name: str) -> str:
        own = self._ros.node
        if name.startswith("~"):
            return check_name(own.full_name + name[1:])
        return check_name(name if name.startswith("/") else f"{own.namespace.rstrip('/')}/{name}")

    def _hash(self, name: str, full: str) -> str:
        """As others have it there; else as on a robot that knows no hashes; else by its definition."""
        there = {one.hash for one in self._ros.graph.on(name) if one.type == full and one.hash != NO_HASH}
        if there:
            return min(there)
        if any(one.hash == HASH_NOT_SUPPORTED for one in self._ros.graph.endpoints(others=True)):
            return HASH_NOT_SUPPORTED
        return self._hashes.of(full)


class Publisher:
    """Publishes a topic, until `close` or the end of its node."""

    def __init__(self, made: RosPublisher, of_type: str, types: Types) -> None:
        self._made = made
        self._type = of_type
        self._types = types

    @property
    def topic(self) -> str:
        """Its full name."""
        return self._made.endpoint.topic

    def publish(self, value: Value | bytes) -> None:
        """Publish a message, as a Python value or as CDR. Raises BadValue, UsageError."""
        self._made.publish(value if isinstance(value, bytes) else self._types.serialize(self._type, value))

    def close(self) -> None:
        """Publish no more. Closing twice is allowed."""
        self._made.close()


class Subscription:
    """Messages of a topic, the oldest first, until `close` or the end of its node."""

    INBOX = 1000

    def __init__(self, node: Node, topic: str, of_type: str, type_hash: str, qos: Qos) -> None:
        self._node = node
        self._type = of_type
        self._topic = topic
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[Message] = deque()
        self._arrived = asyncio.Event()
        self._closed = False
        self._made: RosSubscription = node._ros.subscription(topic, of_type, type_hash, qos, self._take)

    async def receive(self) -> Message:
        """The next message. Raises Closed."""
        while not self._waiting:
            if self._closed:
                raise Closed(f"the subscription of {self._topic}")
            self._arrived.clear()
            await self._arrived.wait()
        return self._waiting.popleft()

    async def __aiter__(self) -> AsyncIterator[Message]:
        with suppress(Closed):
            while True:
                yield await self.receive()

    def close(self) -> None:
        """Subscribe no more. Closing twice is allowed."""
        self._closed = True
        self._made.close()
        self._arrived.set()

    def _take(self, cdr: bytes, attached: Attachment) -> None:
        """In a thread of Zenoh's."""
        message = Message(self._topic, self._type, cdr, attached, self._node.types)
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._put, message)

    def _put(self, message: Message) -> None:
        if len(self._waiting) >= self.INBOX:
            self._waiting.popleft()
            self._node.drops.note("inbox_full", self._topic, "messages come faster than they are taken")
        self._waiting.append(message)
        self._arrived.set()


class Service:
    """A service of this program, until `close` or the end of its node."""

    def __init__(self, node: Node, name: str, of_type: str, type_hash: str, handler: Handler) -> None:
        self._node = node
        self._type = of_type
        self._name = name
        self._handler = handler
        self._loop = asyncio.get_running_loop()
        self._answering: set[asyncio.Task[None]] = set()
        self._made: RosService = node._ros.service(name, of_type, type_hash, self._asked)

    def close(self) -> None:
        """Answer no more. Closing twice is allowed."""
        self._made.close()
        for answering in self._answering:
            answering.cancel()

    def _asked(self, request: Request) -> None:
        """In a thread of Zenoh's."""
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._answer_later, request)

    def _answer_later(self, request: Request) -> None:
        task = self._loop.create_task(self._answer(request))
        self._answering.add(task)
        task.add_done_callback(self._answering.discard)

    async def _answer(self, request: Request) -> None:
        types = self._node.types
        try:
            answer = await self._handler(types.deserialize(request_of(self._type), request.cdr))
            cdr = answer if isinstance(answer, bytes) else types.serialize(response_of(self._type), answer)
            self._made.answer(request, cdr)
        except Exception:
            request.query.drop()  # type: ignore[no-untyped-call]
            self._node.drops["failed"] += 1
            log.exception("%s: a request failed", self._name)


def _type(name: str, kind: str = "msg") -> str:
    """``std_msgs/String`` or ``std_msgs/msg/String`` → the latter. Raises UnknownType."""
    parts = name.split("/")
    if len(parts) == 2:
        parts.insert(1, kind)
    if len(parts) != 3 or parts[1] != kind:
        raise UnknownType(name, f"write it as pkg/Name or pkg/{kind}/Name")
    return "/".join(parts)


@asynccontextmanager
async def node(
    name: str,
    *,
    namespace: str = "/",
    domain: int = 0,
    connect: Sequence[str] = (),
    settings: MeshSettings | None = None,
    session_namespace: str | None = None,
    definitions: Sequence[str | Path] = (),
    on_waiting: Callable[[str], None] | None = None,
) -> AsyncIterator[Node]:
    """Be a ROS node until the end of the block.

    Args:
        name: of the node, as ``battery``.
        namespace: as ``/robot7``.
        domain: its ``ROS_DOMAIN_ID``.
        connect: endpoints of routers, tried in order; the robot's own is ``tcp/127.0.0.1:7447``, the default.
        settings: how to reach the router otherwise, as with TLS.
        session_namespace: of its Zenoh session, as ``robot7``.
        definitions: folders with ``.msg`` and ``.srv`` files of types that rosbags does not bring.
        on_waiting: called once while no router answers.

    Raises UsageError, ConfigError, MissingExtra.
    """
    if _NAME.fullmatch(name) is None:
        raise UsageError(f"{name[:80]!r} is no name of a ROS node")
    if namespace != "/":
        check_name(namespace)
    reach = changed(settings or MeshSettings(), connect=list(connect) or None, namespace=session_namespace)
    types = await asyncio.to_thread(Types, list(definitions))
    async with await RosNetwork.open(reach, on_waiting=on_waiting) as network:
        await network.known(domain)
        made = Node(network, network.node(domain, name, namespace), types)
        try:
            yield made
        finally:
            made.close()
