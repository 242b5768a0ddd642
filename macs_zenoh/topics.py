"""What users of robots' topics have in their hands: subscriptions, publishers, messages. Asyncio.

`nodes` keeps the registrations that they share.
"""

from __future__ import annotations

import asyncio
import builtins
import logging
from collections import deque
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeGuard, TypeVar

from .errors import Closed, OutOfRange, UsageError
from .handles import Callbacks, Handle
from .held import Held
from .protocol.messages import ROS, AddNode, Metadata, NodeType
from .protocol.offers import short_type
from .protocol.registrations import NodeKey
from .typed import Types

if TYPE_CHECKING:
    from .nodes import Nodes

log = logging.getLogger("macs.agent")

DEPTH = 10
"""Messages that are held for one node, at the robot and here, unless asked otherwise: a headset's default."""

Value = Mapping[str, object]
Chosen = int | Collection[int]
"""One robot or group, or several."""
OnRefused = Callable[[int, str], None]
Self = TypeVar("Self", bound="NodeUser")


class TopicMessage:
    """A message of a robot's topic: who sent it, and its CDR; `value` is what it says."""

    __slots__ = ("_types", "data", "received_s", "robot", "topic", "type")

    def __init__(
        self, robot: int, topic: str, of_type: str, data: bytes, types: Callable[[], Types], received_s: float = 0.0
    ) -> None:
        self.robot = robot
        self.topic = topic
        self.type = of_type
        self.data = data
        self.received_s = received_s
        """When it came, by the monotonic clock."""
        self._types = types

    def __repr__(self) -> str:
        return f"<TopicMessage {self.topic} ({self.type}) of robot {self.robot}, {len(self.data)} bytes>"

    @property
    def value(self) -> dict[str, Any]:
        """The message as a JSON-able object (see `Types`). Raises MissingExtra, UnknownType, BadCdr."""
        return self._types().deserialize(self.type, self.data)


OnTopicMessage = Callable[[TopicMessage], None]


@dataclass(eq=False)
class Node:
    """An interface node that robots have, or shall have, for this agent."""

    wanted: AddNode
    users: list[NodeUser] = field(default_factory=list)
    confirmed: set[int] = field(default_factory=set)
    refused: dict[int, str] = field(default_factory=dict)
    """Robots that refused it, and why; 0 for all of them."""
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    held: dict[int, Held[TopicMessage]] = field(default_factory=dict)
    """By robot, for subscriptions that come later."""

    @property
    def topic(self) -> str:
        return self.wanted.tos_name

    @property
    def key(self) -> NodeKey:
        return (self.wanted.node_type, self.wanted.node_name)

    @property
    def robots(self) -> set[int]:
        return {robot for user in self.users for robot in user.robots}

    @property
    def groups(self) -> set[int]:
        return {group for user in self.users for group in user.groups}

    def let_go(self, robot: int | None = None) -> None:
        """What was heard last of a robot, or of all, is not held any more."""
        for each in list(self.held) if robot is None else [robot]:
            if (held := self.held.pop(each, None)) is not None:
                held.clear()


class NodeUser:
    """One use of an interface node, until `close`."""

    def __init__(self, nodes: Nodes, node: Node, robots: frozenset[int], groups: frozenset[int]) -> None:
        self.robots = robots
        self.groups = groups
        self.is_open = True
        self._nodes = nodes
        self._node = node
        self._on_refused: Callbacks[OnRefused] = Callbacks()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.topic} ({self.type})>"

    @property
    def topic(self) -> str:
        """The name of the topic or service."""
        return self._node.topic

    @property
    def type(self) -> str:
        """Its type, as ``geometry_msgs/Twist``."""
        return self._node.wanted.data_exchange_type

    @property
    def refused(self) -> dict[int, str]:
        """The robots that do not take part, and why; 0: all of them."""
        return {
            robot: why for robot, why in self._node.refused.items() if robot == 0 or self._nodes.means(self, robot)
        }

    def on_refused(self, callback: OnRefused) -> Handle:
        """Call ``callback(robot, reason)`` when a robot refuses the node from now on, or something sent for it."""
        return self._on_refused.add(callback)

    def told_refused(self, robot: int, reason: str) -> None:
        """A robot refuses this."""
        for callback in self._on_refused:
            try:
                callback(robot, reason)
            except Exception:  # whoever listens; what else is to be done goes on
                log.exception("a callback of %s failed", self.topic)

    def close(self) -> None:
        """End it: robots are told, unless others in this program use the same. Closing twice is allowed."""
        if self.is_open:
            self.is_open = False
            self._nodes.leave(self._node, self)

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(
        self, kind: builtins.type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class TopicSubscription(NodeUser):
    """A topic of robots. Iterate over it for `TopicMessage`, or `receive` one.

    It holds the last ``depth`` messages for who takes them too slowly; ``dropped`` counts the others, and the agent's
    ``drops`` all of them as ``topic_full``.
    """

    def __init__(
        self, nodes: Nodes, node: Node, robots: frozenset[int], groups: frozenset[int], depth: int = DEPTH
    ) -> None:
        super().__init__(nodes, node, robots, groups)
        self.depth = depth
        self.dropped = 0
        self._waiting: deque[TopicMessage] = deque()
        self._arrived = asyncio.Event()
        self._handler: OnTopicMessage | None = None

    def on_message(self, handler: OnTopicMessage) -> Handle:
        """Pass messages to ``handler``, as they come and on the loop, instead of holding them for `receive`; it should
        not raise. There is one handler at a time; when the handle is closed, messages are held again."""
        self._handler = handler
        while self._waiting:
            handler(self._waiting.popleft())

        def end() -> None:
            if self._handler is handler:
                self._handler = None

        return Handle(end)

    def put(self, message: TopicMessage) -> bool:
        """Hold a message; False when an older one had to go."""
        if self._handler is not None:
            self._handler(message)
            return True
        full = len(self._waiting) >= self.depth
        if full:
            self._waiting.popleft()
            self.dropped += 1
        self._waiting.append(message)
        self._arrived.set()
        return not full

    def put_before(self, messages: Collection[TopicMessage]) -> None:
        """Older ones, as far as there is room beside those that wait."""
        room = self.depth - len(self._waiting)
        self._waiting.extendleft(list(messages)[: -room - 1 : -1] if room > 0 else ())
        self._arrived.set()

    async def receive(self) -> TopicMessage:
        """The next message. Raises Closed once the subscription or its agent is."""
        while not self._waiting:
            if not self.is_open:
                raise Closed(f"the subscription of {self.topic}")
            self._arrived.clear()
            await self._arrived.wait()
        return self._waiting.popleft()

    async def __aiter__(self) -> AsyncIterator[TopicMessage]:
        """All messages until it is closed."""
        while True:
            try:
                yield await self.receive()
            except Closed:
                return

    def close(self) -> None:
        super().close()
        self._arrived.set()


class TopicPublisher(NodeUser):
    """A topic of robots that this agent publishes to. What it sends may move them."""

    def publish(self, data: bytes | Value) -> None:
        """Send one message, as CDR or as a value of the topic's type, to the robots and groups that were named.

        A robot that does not take it tells why: `on_refused`. Raises Closed, and what `Types.serialize` raises.
        """
        if not self.is_open:
            raise Closed(f"the publisher of {self.topic}")
        cdr = data if is_cdr(data) else self._nodes.types().serialize(self.type, value_of(data))
        metadata = Metadata(node_type=NodeType.PUBLISHER, node_name=self._node.key[1], data_exchange_type=self.type)
        self._nodes.agent.send(cdr, to=ROS, ids=sorted(self.robots), groups=sorted(self.groups), metadata=metadata)


class ServiceUser(NodeUser):
    """A service of robots that this agent calls."""


def chosen(robot: Chosen, group: Chosen) -> tuple[frozenset[int], frozenset[int]]:
    """The robots and groups that are meant. Raises UsageError, OutOfRange."""
    robots = frozenset([robot] if isinstance(robot, int) else robot)
    groups = frozenset([group] if isinstance(group, int) else group)
    if not robots and not groups:
        raise UsageError("of which robot? give robot= or group=")
    for name, numbers, highest in (("robot", robots, 0xFFFF), ("group", groups, 255)):
        for number in numbers:
            if not 1 <= number <= highest:
                raise OutOfRange(name, number, 1, highest)
    return robots, groups


def is_cdr(data: object) -> TypeGuard[bytes]:
    """Whether it is bytes, which are sent as they are."""
    return isinstance(data, bytes | bytearray | memoryview)


def is_other(of_type: str | None, user: NodeUser) -> bool:
    """Whether another type is meant than the one in use."""
    return of_type is not None and short_type(of_type) != user.type


def value_of(data: object) -> Value:
    """The same, if it is a value. Raises UsageError."""
    if not isinstance(data, Mapping):
        raise UsageError(f"a message is bytes (CDR) or a value with its fields, not {type(data).__name__}")
    return data
