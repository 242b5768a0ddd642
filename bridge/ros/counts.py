"""How many messages of a topic were put on the mesh for each who registered, and the verb ``status``, by which they
have themselves told.

Zenoh drops topic data where a link is full, and tells nobody. The count goes the way of the messages, behind the last
of them, so whoever has it knows how many did not come.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Iterable

from bridge.ros.interface import InterfaceNode, Registrant
from macs_zenoh.errors import WireError
from macs_zenoh.protocol.keyexpr import type_number
from macs_zenoh.protocol.messages import decode_data
from macs_zenoh.protocol.robot_state import StatusRequest, StreamCount
from macs_zenoh.serving import Call, CallHandler

SETS = 16
"""So many sets of receivers are counted by themselves before the counts of each of them are made anew."""
AGAIN_S = 0.5
"""Who asks again so soon is told nothing: one question has a message put for each topic on which he is registered."""
ASKED = 1024
"""Of so many it is remembered when they asked."""


class PutFor:
    """One topic's. From any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._new: Counter[Collection[tuple[int, int]]] = Counter()
        """By who gets it: messages that are not in the counts of each of them yet."""
        self._counts: dict[tuple[int, int], StreamCount] = {}
        self._told: dict[tuple[int, int], int] = {}

    def registered(self, registrants: Iterable[tuple[int, int]]) -> None:
        """These are registered now: who is new is counted for from now on."""
        with self._lock:
            self._sum_up()
            since = time.monotonic_ns()
            self._counts = {each: self._counts.get(each) or StreamCount(since) for each in registrants}
            self._told = {each: told for each, told in self._told.items() if each in self._counts}

    def add(self, receivers: Collection[tuple[int, int]]) -> None:
        """One message was put for these."""
        with self._lock:
            self._new[receivers] += 1
            if len(self._new) > SETS:
                self._sum_up()

    def to_tell(self, registrant: tuple[int, int], *, again: bool) -> StreamCount | None:
        """What this one is to be told: nothing that it was told before, unless ``again``."""
        with self._lock:
            self._sum_up()
            count = self._counts.get(registrant)
            if count is None or (self._told.get(registrant, 0) == count.put and not again):
                return None
            self._told[registrant] = count.put
            return count

    def _sum_up(self) -> None:
        new, self._new = self._new, Counter()
        for receivers, more in new.items():
            for each in receivers:
                if (count := self._counts.get(each)) is not None:
                    self._counts[each] = StreamCount(count.since, count.put + more)


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
        sender = Registrant(type_number(call.sender_type), call.sender_id)
        if asked and may_ask(sender):
            for node in nodes:
                node.tell_count(sender, again=asked == "all")
        return state()

    return answer
