"""Interface nodes: what headsets register on a robot, each the robot's end of one topic.

`InterfaceNodes` belongs to the event loop; rclpy's entities are made and destroyed in the ROS thread. Topic data
crosses as bytes, never decoded: from the ROS thread straight into the mesh, from the loop straight into a publisher.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks, UnsupportedEventTypeError
from rclpy.exceptions import NameValidationException
from rclpy.type_support import NoTypeSupportImportedException

from bridge.ros import qos
from bridge.ros.early import EarlyMessages, NodeKey
from bridge.ros.session import RosSession
from bridge.ros.stream import StreamFraming, cdr_problem
from bridge.ros.types import InterfaceName, least_cdr_bytes, resolve
from macs_zenoh.agent import Message
from macs_zenoh.errors import MacsError, Refused
from macs_zenoh.messages import ROS, AddNode, Metadata, NodeType, RemoveNode, StreamData
from macs_zenoh.wire import MACS, Layout

log = logging.getLogger("macs.ros")

PublishStream = Callable[[str, bytes], None]
"""Node name and whole frame; called in the ROS thread."""


class Registrant(NamedTuple):
    """An agent that registered an interface node."""

    agent_type: int
    agent_id: int


class Drops(Counter[str]):
    """What was lost, by name.

    ``no_node`` data for a node that is not registered; ``held_full`` data before its registration, more than is kept;
    ``bad_cdr`` data that cannot be a ROS message; ``lost_in_ros`` messages that ROS lost before we could take them;
    ``failed`` messages that ROS or the mesh did not take.
    """

    LOGGED = 1000
    """Names come from the network, so what is remembered of them is bounded."""

    def __init__(self) -> None:
        super().__init__()
        self._logged: set[tuple[str, str]] = set()

    def note(self, name: str, about: str, text: str, count: int = 1) -> None:
        """Count a loss; log it the first time it concerns ``about``."""
        self[name] += count
        if (name, about) not in self._logged and len(self._logged) < self.LOGGED:
            self._logged.add((name, about))
            log.warning("%s: %s (logged once, counted as %s)", about, text, name)


@dataclass(frozen=True)
class Robot:
    """What interface nodes work with.

    Attributes:
        session: the ROS node and its thread.
        agent_id: the robot's id on the mesh.
        publish_stream: puts a frame on the mesh.
        layout: of the mesh's frames.
    """

    session: RosSession
    agent_id: int
    publish_stream: PublishStream
    layout: Layout = MACS
    drops: Drops = field(default_factory=Drops)


class InterfaceNodes:
    """All interface nodes of a robot, by node type and node name."""

    def __init__(self, robot: Robot, max_nodes: int = 256) -> None:
        self.drops = robot.drops
        self._robot = robot
        self._max_nodes = max_nodes
        self._nodes: dict[NodeKey, InterfaceNode] = {}
        self._early = EarlyMessages()
        self._expiry: asyncio.TimerHandle | None = None

    def __len__(self) -> int:
        return len(self._nodes)

    def get(self, node_type: int, node_name: str) -> InterfaceNode | None:
        """An interface node, None when nobody registered it."""
        return self._nodes.get(NodeKey(node_type, node_name))

    async def add(self, request: AddNode) -> None:
        """Register an agent on an interface node, which the first registration creates.

        A repeated registration changes nothing; a further registrant takes the node as it is.
        Raises Refused: node type not supported, invalid name, type not installed, type of the topic is another one,
        name taken by another topic, limit reached.
        """
        node = self._nodes.get(_key(request))
        if node is None:
            node = self._create(request)
        else:
            node.check_same(request)
        node.register(Registrant(request.registrant_agent_type, request.registrant_agent_id))
        assert node.opening is not None
        await asyncio.shield(node.opening)

    def remove(self, request: RemoveNode) -> None:
        """Take a registrant off a node; the last one removes it. Asking for what is not there changes nothing."""
        node = self._nodes.get(_key(request))
        if node is not None:
            self._deregister(node, Registrant(request.registrant_agent_type, request.registrant_agent_id))

    def forget(self, registrant: Registrant) -> None:
        """Take an agent that left off every node."""
        for node in [node for node in self._nodes.values() if registrant in node.registrants]:
            self._deregister(node, registrant)

    def deliver(self, message: Message) -> None:
        """Pass a message that names an interface node to it. Never raises for what a peer sent.

        A registration is a call of its own, which the first message can overtake: a few wait for a moment.
        """
        key = NodeKey(message.metadata.node_type, message.metadata.node_name)
        node = self._nodes.get(key)
        if node is not None and node.is_open:
            node.receive(message)
            return
        dropped = self._early.hold(key, message, asyncio.get_running_loop().time())
        if dropped:
            self.drops.note("held_full", key.node_name[:80], "more data before the registration than can be kept")
        self._schedule_expiry()

    def close(self) -> None:
        """Remove all nodes."""
        for node in list(self._nodes.values()):
            self._remove(node)
        if self._expiry is not None:
            self._expiry.cancel()

    def _create(self, request: AddNode) -> InterfaceNode:
        kind = KINDS.get(request.node_type)
        if kind is None:
            known = NodeType.__members__.values()
            reason = "not supported yet" if request.node_type in known else "unknown"
            raise Refused(f"interface node type {request.node_type} is {reason} on this robot")
        if len(self._nodes) >= self._max_nodes:
            raise Refused(f"this robot has {self._max_nodes} interface nodes, which is its limit")
        node = kind(self._robot, request)
        self._nodes[node.key] = node
        opened = self._robot.session.submit(node.open)  # now, so that it comes before `close`, whenever that comes
        node.opening = asyncio.get_running_loop().create_task(self._open(node, asyncio.wrap_future(opened)))
        node.opening.add_done_callback(_retrieve)
        return node

    async def _open(self, node: InterfaceNode, opened: asyncio.Future[None]) -> None:
        try:
            await opened
            await node.settle()
        except BaseException:
            if self._nodes.get(node.key) is node:
                del self._nodes[node.key]
            raise
        if self._nodes.get(node.key) is not node:  # its registrants left meanwhile
            return
        node.is_open = True
        log.info("%s: %s %s", node.topic, node.ROLE, node.interface)
        for message in self._early.take(node.key):
            node.receive(message)

    def _deregister(self, node: InterfaceNode, registrant: Registrant) -> None:
        node.deregister(registrant)
        if not node.registrants:
            self._remove(node)

    def _remove(self, node: InterfaceNode) -> None:
        del self._nodes[node.key]
        node.is_open = False
        self._robot.session.submit(node.close)
        log.info("%s: %s removed", node.topic, node.ROLE)

    def _schedule_expiry(self) -> None:
        if self._expiry is None and (deadline := self._early.next_deadline()) is not None:
            self._expiry = asyncio.get_running_loop().call_at(deadline, self._expire)

    def _expire(self) -> None:
        self._expiry = None
        for key, count in self._early.expire(asyncio.get_running_loop().time()).items():
            name = key.node_name[:80]
            self.drops.note("no_node", name, f"nobody registered this node with type {key.node_type}", count)
        self._schedule_expiry()


class InterfaceNode(ABC):
    """One interface node: its registrants, and its rclpy entity between `open` and `close`."""

    NODE_TYPE: ClassVar[NodeType]
    ROLE: ClassVar[str]
    INTERFACE: ClassVar[str] = "msg"
    """Kind of its ROS interface."""
    MAX_REGISTRANTS: ClassVar[int | None] = None

    def __init__(self, robot: Robot, request: AddNode) -> None:
        """Check the names. Raises Refused."""
        self.robot = robot
        self.key = _key(request)
        self.request = request
        self.topic = resolve_name(robot.session, request.tos_name)
        self.interface = InterfaceName.parse(request.data_exchange_type, self.INTERFACE)
        self.registrants: set[Registrant] = set()
        self.is_open = False
        self.opening: asyncio.Task[None] | None = None
        if not _NODE_NAME.fullmatch(request.node_name):
            raise Refused(f"{request.node_name[:80]!r} is not a valid node name")

    def check_same(self, request: AddNode) -> None:
        """Raise Refused when another topic or type is wanted under this node's name."""
        topic = resolve_name(self.robot.session, request.tos_name)
        if topic != self.topic:
            raise Refused(f"{topic} and {self.topic} have the same node name {self.key.node_name}; use one of them")
        interface = InterfaceName.parse(request.data_exchange_type, self.INTERFACE)
        if interface != self.interface:
            raise Refused(f"{topic} is registered with type {self.interface}, not {interface}")

    def register(self, registrant: Registrant) -> None:
        """Add a registrant; twice changes nothing. Raises Refused when the node takes no more."""
        if registrant in self.registrants:
            return
        if self.MAX_REGISTRANTS is not None and len(self.registrants) >= self.MAX_REGISTRANTS:
            raise Refused(f"{self.topic} is already registered by another agent, and {self.ROLE} has only one")
        self.registrants.add(registrant)
        self.registrants_changed()

    def deregister(self, registrant: Registrant) -> None:
        """Take a registrant off, if it is there."""
        if registrant in self.registrants:
            self.registrants.remove(registrant)
            self.registrants_changed()

    def registrants_changed(self) -> None:  # noqa: B027 - only some nodes care
        """Somebody registered or left."""

    @abstractmethod
    def open(self) -> None:
        """Create the rclpy entity. In the ROS thread. Raises Refused."""

    async def settle(self) -> None:  # noqa: B027 - only some nodes have to wait
        """Wait, on the loop and not for long, until the entity can do its work."""

    @abstractmethod
    def close(self) -> None:
        """Destroy the rclpy entity, if there is one. In the ROS thread."""

    @abstractmethod
    def receive(self, message: Message) -> None:
        """Take a message that names this node. On the loop."""


class SubscriberNode(InterfaceNode):
    """Type 1: a robot's topic to its registrants, one frame per message whoever receives it."""

    NODE_TYPE = NodeType.SUBSCRIBER
    ROLE = "subscriber"

    BURST = 64
    """Messages taken in one turn of the executor: a turn costs more than a message."""

    def __init__(self, robot: Robot, request: AddNode) -> None:
        super().__init__(robot, request)
        self._subscription: Any = None
        self._profile: Any = None
        self._message: type[Any] | None = None
        self._frame = self._framing()

    def registrants_changed(self) -> None:
        self._frame = self._framing()

    def open(self) -> None:
        self._message = resolve(str(self.interface))
        _check_topic_type(self.robot.session.node, self.request.tos_name, self.interface)
        self._subscribe(self._profile_of(self._publishers()))

    def close(self) -> None:
        subscription, self._subscription = self._subscription, None
        if subscription is not None:
            self.robot.session.node.destroy_subscription(subscription)

    def receive(self, message: Message) -> None:
        self.robot.drops.note("no_node", self.key.node_name, "data for a node that only sends")

    def _framing(self) -> StreamFraming:
        metadata = Metadata(
            sender_agent_type=ROS,
            sender_agent_id=self.robot.agent_id,
            message_manager=StreamData.manager,
            node_type=self.NODE_TYPE,
            node_name=self.key.node_name,
            data_exchange_type=self.interface.short,
        )
        return StreamFraming(metadata, self.registrants, self.robot.layout)

    # -- in the ROS thread ---------------------------------------------------------------------------------------

    def _publishers(self) -> list[Any]:
        found = self.robot.session.node.get_publishers_info_by_topic(self.request.tos_name)
        return [endpoint.qos_profile for endpoint in found]

    def _profile_of(self, publishers: Iterable[Any]) -> Any:
        return qos.for_subscription(publishers, qos.depth_of(self.request.buffer_size))

    def _subscribe(self, profile: Any) -> None:
        node, topic = self.robot.session.node, self.request.tos_name
        events = SubscriptionEventCallbacks(
            matched=self._publisher_matched,
            incompatible_qos=self._publisher_incompatible,
            message_lost=self._lost,
            use_default_callbacks=False,
        )
        with _ros_errors(topic):
            try:
                self._subscription = node.create_subscription(
                    self._message, topic, self._forward, profile, raw=True, event_callbacks=events
                )
            except UnsupportedEventTypeError:  # of some middlewares; then the QoS stays as it is
                self._subscription = node.create_subscription(self._message, topic, self._forward, profile, raw=True)
        self._profile = profile

    def _forward(self, cdr: bytes) -> None:
        self._publish(cdr)
        handle, message = self._subscription.handle, self._message
        with handle:
            for _ in range(self.BURST):
                taken = handle.take_message(message, True)
                if taken is None:
                    return
                self._publish(taken[0])

    def _publish(self, cdr: bytes) -> None:
        try:
            self.robot.publish_stream(self.key.node_name, self._frame(cdr))
        except MacsError as error:
            self.robot.drops.note("failed", self.topic, str(error))

    def _publisher_matched(self, change: Any) -> None:
        if change.current_count_change > 0:
            self.robot.session.submit(self._follow)

    def _publisher_incompatible(self, _change: Any) -> None:
        self.robot.session.submit(self._follow)

    def _follow(self) -> None:
        """Adopt the QoS of publishers that came after us."""
        publishers = self._publishers()
        if self._subscription is None or not publishers:
            return
        profile = self._profile_of(publishers)
        if not qos.same(profile, self._profile):
            log.info("%s: its publishers changed, subscribing again with %s", self.topic, _describe(profile))
            self.close()
            self._subscribe(profile)

    def _lost(self, status: Any) -> None:
        text = "ROS lost messages before they were taken; a larger buffer size may help"
        self.robot.drops.note("lost_in_ros", self.topic, text, int(status.total_count_change))


class PublisherNode(InterfaceNode):
    """Type 2: what agents send to a robot's topic."""

    NODE_TYPE = NodeType.PUBLISHER
    ROLE = "publisher"

    MATCH_S = 0.5
    """How long a new publisher waits for the subscriptions that exist to find it."""

    def __init__(self, robot: Robot, request: AddNode) -> None:
        super().__init__(robot, request)
        self._publisher: Any = None
        self._least_bytes = 4
        self._expected = 0
        self._matched = asyncio.Event()
        self._loop = asyncio.get_running_loop()

    def open(self) -> None:
        message = resolve(str(self.interface))
        self._least_bytes = least_cdr_bytes(message)
        node, topic = self.robot.session.node, self.request.tos_name
        _check_topic_type(node, topic, self.interface)
        subscriptions = [endpoint.qos_profile for endpoint in node.get_subscriptions_info_by_topic(topic)]
        profile = qos.for_publisher(
            subscriptions, qos.depth_of(self.request.buffer_size), latched=self.request.is_latched
        )
        self._expected = len(subscriptions)
        events = PublisherEventCallbacks(matched=self._subscription_matched, use_default_callbacks=False)
        with _ros_errors(topic):
            try:
                self._publisher = node.create_publisher(message, topic, profile, event_callbacks=events)
            except UnsupportedEventTypeError:  # of some middlewares; then the time decides
                self._publisher = node.create_publisher(message, topic, profile)

    async def settle(self) -> None:
        """Let the subscriptions that exist find the new publisher: what is published before that, ROS loses."""
        if self._expected:
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._matched.wait(), self.MATCH_S)

    def _subscription_matched(self, status: Any) -> None:
        if status.current_count >= self._expected:
            self._loop.call_soon_threadsafe(self._matched.set)

    def close(self) -> None:
        publisher, self._publisher = self._publisher, None
        if publisher is not None:
            self.robot.session.node.destroy_publisher(publisher)

    def receive(self, message: Message) -> None:
        problem = cdr_problem(message.data, self._least_bytes)
        if problem is not None:
            text = f"refused {len(message.data)} bytes for {self.interface}: {problem}"
            about = f"{self.topic} from {message.sender_type}/{message.sender_id}"
            self.robot.drops.note("bad_cdr", about, text)
            return
        try:
            self._publisher.publish(message.data)
        except RuntimeError as error:
            self.robot.drops.note("failed", self.topic, f"ROS did not publish: {error}")


KINDS: dict[int, type[InterfaceNode]] = {kind.NODE_TYPE: kind for kind in (SubscriberNode, PublisherNode)}
"""Interface nodes by their number on the wire. Service nodes (CLIENT, SERVICE) get their place here."""


_NODE_NAME = re.compile(r"[A-Za-z0-9_]{1,260}")


def _key(request: AddNode | RemoveNode) -> NodeKey:
    return NodeKey(request.node_type, request.node_name)


def resolve_name(session: RosSession, name: str) -> str:
    """The full name of a topic or service, expanded and remapped for our node. Raises Refused when it is invalid."""
    with _ros_errors(name[:80]):
        return str(session.node.resolve_topic_name(name))


def _check_topic_type(node: Any, topic: str, interface: InterfaceName) -> None:
    """Raise Refused when the topic exists and carries another type. In the ROS thread."""
    endpoints = [*node.get_publishers_info_by_topic(topic), *node.get_subscriptions_info_by_topic(topic)]
    types = {endpoint.topic_type for endpoint in endpoints}
    if types and str(interface) not in types:
        raise Refused(f"{topic} carries {' and '.join(sorted(types))} on this robot, not {interface}")


class _ros_errors:  # noqa: N801 - reads like the context manager that it is
    """Turns rclpy's errors about a topic into a refusal that a person understands."""

    def __init__(self, topic: str) -> None:
        self._topic = topic

    def __enter__(self) -> None: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, RuntimeError | NameValidationException | NoTypeSupportImportedException):
            # rcl adds "at /path/in/its/sources" and a second line that points at the letter
            problem = str(error).splitlines()[0].split(", at ")[0]
            raise Refused(f"{self._topic!r} cannot be used on this robot: {problem}") from error


def _describe(profile: Any) -> str:
    return f"{profile.reliability.name.lower()}, {profile.durability.name.lower()}".replace("_", " ")


def _retrieve(task: asyncio.Task[None]) -> None:
    """Look at the task's error, so that asyncio does not warn when every waiter was cancelled."""
    if not task.cancelled():
        task.exception()
