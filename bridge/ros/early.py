"""Messages that come before the node they are for. Pure."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Collection
from typing import NamedTuple

from macs_zenoh.protocol.budget import may_have_one_more
from macs_zenoh.protocol.keyexpr import type_number
from macs_zenoh.protocol.messages import NodeType
from macs_zenoh.protocol.reading import Message

ASKING = (NodeType.CLIENT, NodeType.ACTION)
"""Node types whose messages wait for an answer."""

Sender = tuple[int, int]
"""Type and id."""


class NodeKey(NamedTuple):
    """What identifies an interface node, on the robot and in every message."""

    node_type: int
    node_name: str


class EarlyMessage(NamedTuple):
    """A message that came before its node."""

    deadline: float
    message: Message


class EarlyMessages:
    """Messages that wait for their node's registration, few and not for long. Each sender has room of its own.

    Pure: the time is passed in.
    """

    HOLD_S = 1.0
    PER_NODE = 16
    CALLS_PER_NODE = 256
    """Of calls and goals, which wait for an answer each."""
    NODES, NODES_IN_ALL = 64, 1024
    """Of one sender, and of all; `budget` says who may have the last of them."""
    BYTES, BYTES_IN_ALL = 8 << 20, 32 << 20

    def __init__(self) -> None:
        self._waiting: dict[tuple[Sender, NodeKey], deque[EarlyMessage]] = {}
        self._nodes: Counter[Sender] = Counter()
        self._bytes: Counter[Sender] = Counter()

    def hold(self, key: NodeKey, message: Message, now: float) -> list[Message]:
        """Keep a message. Those that were lost for want of room: the oldest of its sender and node, or else this."""
        sender, size = _sender(message), len(message.data)
        waiting = self._waiting.get((sender, key))
        used, mine = self._bytes.total(), self._bytes[sender]
        if not may_have_one_more(used, mine, each=self.BYTES, total=self.BYTES_IN_ALL, more=size):
            return [message]
        if waiting is None:
            used, mine = len(self._waiting), self._nodes[sender]
            if not may_have_one_more(used, mine, each=self.NODES, total=self.NODES_IN_ALL):
                return [message]
            waiting = self._waiting[sender, key] = deque()
            self._nodes[sender] += 1
        waiting.append(EarlyMessage(now + self.HOLD_S, message))
        self._bytes[sender] += size
        if len(waiting) <= (self.CALLS_PER_NODE if key.node_type in ASKING else self.PER_NODE):
            return []
        lost = waiting.popleft().message
        self._bytes[sender] -= len(lost.data)
        return [lost]

    def waits(self, sender: Sender) -> bool:
        """Whether anything of one sender waits. From any thread."""
        return sender in self._nodes

    def keys(self, sender: Sender) -> list[NodeKey]:
        """The nodes for which anything of one sender waits."""
        return [key for who, key in self._waiting if who == sender]

    def first(self, sender: Sender, key: NodeKey) -> Message | None:
        """The oldest that waits of one sender for one node. It costs the same however many wait behind it."""
        waiting = self._waiting.get((sender, key))
        return waiting[0].message if waiting else None

    def waited_s(self, key: NodeKey, message: Message, now: float) -> float:
        """For how long one of them has waited here."""
        mine = self._waiting.get((_sender(message), key), ())
        return next((now - (early.deadline - self.HOLD_S) for early in mine if early.message is message), 0.0)

    def remove(self, key: NodeKey, message: Message) -> None:
        """One message waits no more."""
        sender = _sender(message)
        if self.first(sender, key) is message:
            self._take_first(sender, key)
        else:
            self._take(sender, key, lambda early: early.message is message)

    def waiting_for(self, key: NodeKey) -> list[Message]:
        """What waits for one node, of all senders, oldest first."""
        waiting = [early for (_, own), mine in self._waiting.items() if own == key for early in mine]
        return [early.message for early in sorted(waiting, key=lambda early: early.deadline)]

    def drop(self, sender: Sender, kinds: Collection[int] | None = None) -> None:
        """Forget what somebody sent who has left: its id may be another one's by the time there is a node. With
        ``kinds`` only for nodes of these types."""
        for who, key in list(self._waiting):
            if who == sender and (kinds is None or key.node_type in kinds):
                self._take(who, key, lambda early: True)

    def expire(self, now: float) -> dict[NodeKey, list[Message]]:
        """Give up those that waited too long, and return them by node."""
        expired: dict[NodeKey, list[Message]] = {}
        for (sender, key), waiting in list(self._waiting.items()):
            while waiting and waiting[0].deadline <= now:  # the oldest first: those behind it have longer
                expired.setdefault(key, []).append(self._take_first(sender, key))
        return expired

    def next_deadline(self) -> float | None:
        """When `expire` has something to do; None while nothing waits."""
        return min((waiting[0].deadline for waiting in self._waiting.values()), default=None)

    def _take_first(self, sender: Sender, key: NodeKey) -> Message:
        """The oldest of one sender's messages for a node, at a cost that does not grow with those behind it."""
        waiting = self._waiting[sender, key]
        message = waiting.popleft().message
        self._bytes[sender] -= len(message.data)
        if not waiting:
            del self._waiting[sender, key]
            self._nodes[sender] -= 1
            self._forget_empty(sender)
        return message

    def _take(self, sender: Sender, key: NodeKey, wanted: Callable[[EarlyMessage], bool]) -> list[EarlyMessage]:
        """Of one sender's messages for a node."""
        waiting = self._waiting.pop((sender, key))
        taken = [early for early in waiting if wanted(early)]
        left = deque(early for early in waiting if not any(early is one for one in taken)) if taken else waiting
        if left:
            self._waiting[sender, key] = left
        else:
            self._nodes[sender] -= 1
        self._bytes[sender] -= sum(len(early.message.data) for early in taken)
        self._forget_empty(sender)
        return taken

    def _forget_empty(self, sender: Sender) -> None:
        if not self._nodes[sender]:
            del self._nodes[sender], self._bytes[sender]


def _sender(message: Message) -> Sender:
    return type_number(message.sender_type), message.sender_id
