"""What an agent has last heard of a topic, for who subscribes to it as well, later and in the same agent. Pure.

A robot gives what a latched topic holds to each agent once, and all subscriptions of an agent share one registration:
those that come later get it from here. Whether a topic is latched the robot tells, and is asked only then. What other
topics said before is given to nobody: it would be taken for new.
"""

from __future__ import annotations

from collections import deque
from typing import Generic, Protocol, TypeVar

from .errors import WireError
from .protocol.limits import ANSWER_BYTES
from .protocol.messages import decode_data
from .protocol.robot_state import Offered

HELD_BYTES = 1 << 20
"""Of one topic of one robot. Its newest message is held if it is larger as well."""
HELD_IN_ALL_BYTES = 16 << 20
"""Of all topics of one agent. What is heard beyond that is not held."""


class HasData(Protocol):
    """A message with its bytes."""

    @property
    def data(self) -> bytes: ...


Message = TypeVar("Message", bound=HasData)


class Room:
    """What all topics of an agent hold together."""

    def __init__(self, limit_bytes: int = HELD_IN_ALL_BYTES) -> None:
        self.limit_bytes = limit_bytes
        self.bytes = 0


class Held(Generic[Message]):
    """The newest messages of one topic of one robot, as many as the deepest of its subscriptions takes."""

    def __init__(self, room: Room) -> None:
        self._room = room
        self._messages: deque[Message] = deque()
        self._bytes = 0

    def put(self, message: Message, depth: int) -> None:
        """One more; the oldest go."""
        messages = self._messages
        messages.append(message)
        self._count(len(message.data))
        while len(messages) > depth or (self._bytes > HELD_BYTES and len(messages) > 1):
            self._drop()
        while messages and self._room.bytes > self._room.limit_bytes:
            self._drop()

    def newest(self, depth: int) -> list[Message]:
        """As many of them as one subscription takes, the newest last."""
        return list(self._messages)[-depth:]

    def clear(self) -> None:
        """Hold nothing any more."""
        while self._messages:
            self._drop()

    def _drop(self) -> None:
        self._count(-len(self._messages.popleft().data))

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
