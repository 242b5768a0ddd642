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
"""Of one topic of one robot. The newest message is held whatever its size."""


class HasData(Protocol):
    """A message with its bytes."""

    @property
    def data(self) -> bytes: ...


Message = TypeVar("Message", bound=HasData)


class Held(Generic[Message]):
    """The newest messages of one topic of one robot, as many as the deepest of its subscriptions takes."""

    def __init__(self) -> None:
        self._messages: deque[Message] = deque()
        self._bytes = 0

    def put(self, message: Message, depth: int) -> None:
        """One more; the oldest go."""
        self._messages.append(message)
        self._bytes += len(message.data)
        while len(self._messages) > depth or (self._bytes > HELD_BYTES and len(self._messages) > 1):
            self._bytes -= len(self._messages.popleft().data)

    def newest(self, depth: int) -> list[Message]:
        """As many of them as one subscription takes, the newest last."""
        return list(self._messages)[-depth:]


def latches(answer: bytes, topic: str) -> bool:
    """Whether a robot's answer to `offers` says that the topic's publishers hold messages for late ones."""
    try:
        told = decode_data(Offered, answer, ANSWER_BYTES).qos.get(topic)
    except WireError:
        return False
    return told is not None and told.durability == "transient_local"
