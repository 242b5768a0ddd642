"""How many messages of a topic were put on the mesh for each who registered, and the verb ``status``, by which they
have themselves told.

Zenoh drops topic data where a link is full, and tells nobody. The count goes the way of the messages, behind the last
of them, so whoever has it knows how many did not come.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable

from bridge.ros.interface import InterfaceNode, Registrant
from macs_zenoh.errors import WireError
from macs_zenoh.protocol.keyexpr import type_number
from macs_zenoh.protocol.messages import decode_data
from macs_zenoh.protocol.robot_state import StatusRequest, StreamCount
from macs_zenoh.serving import Call, CallHandler

Receivers = frozenset[tuple[int, int]]
AGAIN_S = 0.5
"""Who asks again so soon is told nothing: one question has a message put for each topic on which he is registered."""
ASKED = 1024
"""Of so many it is remembered when they asked."""


class PutFor:
    """One topic's. From any thread. A message to all who are registered costs the same however many they are."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._all: Receivers = frozenset()
        self._put = 0
        """Messages to all who were registered then."""
        self._began: dict[tuple[int, int], tuple[int, int]] = {}
        """By registrant: when it registered, in ns, and how many had been put to all before."""
        self._apart: Counter[tuple[int, int]] = Counter()
        """By registrant: messages that went to some only."""
        self._told: dict[tuple[int, int], int] = {}

    def registered(self, registrants: Receivers) -> None:
        """These are registered now: who is new is counted for from now on."""
        with self._lock:
            for gone in self._began.keys() - registrants:
                del self._began[gone]
                self._apart.pop(gone, None)
                self._told.pop(gone, None)
            now = (time.monotonic_ns(), self._put)
            self._began.update(dict.fromkeys(registrants - self._began.keys(), now))
            self._all = registrants

    def add(self, receivers: Receivers) -> None:
        """One message was put for these."""
        with self._lock:
            if receivers is self._all:
                self._put += 1
                return
            for each in receivers:  # some, or those who were registered when it began to be put
                if each in self._began:
                    self._apart[each] += 1

    def to_tell(self, registrant: tuple[int, int], *, again: bool) -> StreamCount | None:
        """What this one is to be told: nothing that it was told before, unless ``again``."""
        with self._lock:
            began = self._began.get(registrant)
            if began is None:
                return None
            since, before = began
            put = self._put - before + self._apart[registrant]
            if self._told.get(registrant, 0) == put and not again:
                return None
            self._told[registrant] = put
            return StreamCount(since, put)


def telling(
    nodes: Iterable[InterfaceNode], state: Callable[[], bytes], now: Callable[[], float] = time.monotonic
) -> CallHandler:
    """Answers the verb ``status`` with the robot's state; who asks for it is told before that how much was put for
    it. Data that is no such request is ignored, as robots always have."""
    asked_at: OrderedDict[Registrant, float] = OrderedDict()

    def may_ask(sender: Registrant) -> bool:
        if now() < asked_at.get(sender, -AGAIN_S) + AGAIN_S:
            return False
        asked_at[sender] = now()
        asked_at.move_to_end(sender)
        if len(asked_at) > ASKED:
            asked_at.popitem(last=False)
        return True

    async def answer(call: Call) -> bytes:
        try:
            asked = decode_data(StatusRequest, call.data).counts if call.data else ""
        except WireError:
            asked = ""
        if asked:
            sender = Registrant(type_number(call.sender_type), call.sender_id)
            for node in nodes if may_ask(sender) else ():
                node.tell_count(sender, again=asked == "all")
        return state()

    return answer
