"""What an agent has last heard of a topic, for who subscribes to it as well, later and in the same agent. Pure.

A robot gives what a latched topic holds to each agent once, and all subscriptions of an agent share one registration:
those that come later get it from here. Whether a topic is latched the robot tells, and is asked only then. What other
topics said before is given to nobody: it would be taken for new.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Generic, Protocol, TypeVar

from .errors import WireError
from .protocol.limits import ANSWER_BYTES
from .protocol.messages import decode_data
from .protocol.robot_state import Offered

HELD_BYTES = 1 << 20
"""Of one topic of one robot. Its newest message is held if it is larger as well."""
HELD_IN_ALL_BYTES = 16 << 20
"""Of all topics of one agent. Beyond that, those go first that bring most bytes a second: cameras, no maps."""
RATE_S = 10.0
"""A rate is counted over at least so long, so that one message is no stream yet."""


class Heard(Protocol):
    """A message with its bytes, and when it came in seconds."""

    @property
    def data(self) -> bytes: ...

    @property
    def received_s(self) -> float: ...


Message = TypeVar("Message", bound=Heard)


class Room:
    """What all topics of an agent hold together."""

    def __init__(self, limit_bytes: int = HELD_IN_ALL_BYTES) -> None:
        self.limit_bytes = limit_bytes
        self.bytes = 0
        self.holding: set[Held[Any]] = set()

    def make(self, now: float) -> None:
        """Where it is too little, what brings most bytes a second holds less."""
        while self.bytes > self.limit_bytes:
            max(self.holding, key=lambda held: held.rate(now)).give_way()


class Held(Generic[Message]):
    """The newest messages of one topic of one robot, as many as the deepest of its subscriptions takes."""

    def __init__(self, room: Room) -> None:
        self.is_short = False
        """Whether messages are missing for which there was no room."""
        self._room = room
        self._messages: deque[Message] = deque()
        self._bytes = 0
        self._heard_bytes = 0
        self._since: float | None = None

    def put(self, message: Message, depth: int) -> None:
        """One more; the oldest go."""
        messages, size = self._messages, len(message.data)
        if self._since is None:
            self._since = message.received_s
        self._heard_bytes += size
        messages.append(message)
        self._room.holding.add(self)
        self._count(size)
        while len(messages) > depth or (self._bytes > HELD_BYTES and len(messages) > 1):
            self._drop()
            self.is_short = False
        self.is_short = self.is_short and len(messages) < depth
        self._room.make(message.received_s)

    def rate(self, now: float) -> float:
        """Bytes a second that it brings."""
        return self._heard_bytes / max(RATE_S, now - (now if self._since is None else self._since))

    def give_way(self) -> None:
        """Its oldest goes: there is no room for it."""
        self._drop()
        self.is_short = True

    def newest(self, depth: int) -> list[Message]:
        """As many of them as one subscription takes, the newest last."""
        return list(self._messages)[-depth:]

    def clear(self) -> None:
        """Hold nothing any more."""
        while self._messages:
            self._drop()

    def _drop(self) -> None:
        self._count(-len(self._messages.popleft().data))
        if not self._messages:
            self._room.holding.discard(self)

    def _count(self, size: int) -> None:
        self._bytes += size
        self._room.bytes += size


def latches(answer: bytes, topic: str) -> bool:
    """Whether a robot's answer to `offers` says that the topic's publishers hold messages for late ones."""
    try:
        told = decode_data(Offered, answer, ANSWER_BYTES).qos.get(topic)
    except WireError:
        return False
    return told is not None and told.durability == "transient_local"
