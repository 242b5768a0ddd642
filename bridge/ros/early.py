"""Messages that come before the node they are for. Pure: the time is passed in."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from macs_zenoh.keyexpr import type_number
from macs_zenoh.messages import NodeType
from macs_zenoh.reading import Message

ASKING = (NodeType.CLIENT, NodeType.ACTION)
"""Node types whose messages wait for an answer."""


class NodeKey(NamedTuple):
    """What identifies an interface node, on the robot and in every message."""

    node_type: int
    node_name: str


class EarlyMessage(NamedTuple):
    """A message that came before its node."""

    deadline: float
    message: Message


class EarlyMessages:
    """Messages that wait for their node's registration, few and not for long. Pure: the time is passed in."""

    HOLD_S = 1.0
    PER_NODE = 16
    CALLS_PER_NODE = 256
    """Of calls and goals, which wait for an answer each."""
    NODES = 64
    BYTES = 8 << 20

    def __init__(self) -> None:
        self._waiting: dict[NodeKey, deque[EarlyMessage]] = {}
        self._bytes = 0

    def hold(self, key: NodeKey, message: Message, now: float) -> list[Message]:
        """Keep a message. Those that were lost for want of room: the node's oldest, or else this one."""
        waiting = self._waiting.get(key)
        if (waiting is None and len(self._waiting) >= self.NODES) or self._bytes + len(message.data) > self.BYTES:
            return [message]
        waiting = self._waiting.setdefault(key, deque())
        waiting.append(EarlyMessage(now + self.HOLD_S, message))
        self._bytes += len(message.data)
        if len(waiting) <= (self.CALLS_PER_NODE if key.node_type in ASKING else self.PER_NODE):
            return []
        lost = waiting.popleft().message
        self._bytes -= len(lost.data)
        return [lost]

    def take(self, key: NodeKey, belongs: Callable[[Message], bool] = lambda message: True) -> list[Message]:
        """The messages that wait for a node and belong to it, oldest first; others go on waiting."""
        waiting = self._waiting.pop(key, deque())
        taken = [early.message for early in waiting if belongs(early.message)]
        self._bytes -= sum(len(message.data) for message in taken)
        if len(taken) < len(waiting):
            self._waiting[key] = deque(early for early in waiting if not any(early.message is t for t in taken))
        return taken

    def of(self, sender: tuple[int, int]) -> list[tuple[NodeKey, Message]]:
        """What waits of one sender, with what it is for."""
        return [
            (key, early.message)
            for key, waiting in self._waiting.items()
            for early in waiting
            if (type_number(early.message.sender_type), early.message.sender_id) == sender
        ]

    def drop(self, sender: tuple[int, int]) -> None:
        """Forget what somebody sent who has left: its id may be another one's by the time there is a node."""
        for key in list(self._waiting):
            self.take(key, lambda message: (type_number(message.sender_type), message.sender_id) == sender)

    def expire(self, now: float) -> dict[NodeKey, list[Message]]:
        """Give up those that waited too long, and return them by node."""
        expired: dict[NodeKey, list[Message]] = {}
        for key, waiting in list(self._waiting.items()):
            while waiting and waiting[0].deadline <= now:
                message = waiting.popleft().message
                self._bytes -= len(message.data)
                expired.setdefault(key, []).append(message)
            if not waiting:
                del self._waiting[key]
        return expired

    def next_deadline(self) -> float | None:
        """When `expire` has something to do; None while nothing waits."""
        return min((waiting[0].deadline for waiting in self._waiting.values()), default=None)
