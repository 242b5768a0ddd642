"""Telling agents why what they sent was not taken: a command has no answer, and its sender believes it was done.

Told at once, and again once in a while as long as it goes on: a robot's uplink is not for complaints. To existing
programs their gateway does not pass it on.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable

from macs_zenoh.protocol.messages import DataRefused
from macs_zenoh.protocol.reading import Message

AGAIN_S = 1.0
"""After so long the same is told again."""
REMEMBERED = 1024
"""Agents and nodes of which it is known when they were told last; names come from the network."""


class Refusals:
    """When to tell whom what. From any thread."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._lock = threading.Lock()
        self._told: OrderedDict[tuple[object, ...], float] = OrderedDict()

    def due(self, message: Message, robot_id: int, topic: str, kind: str, reason: str) -> DataRefused | None:
        """What to tell a message's sender, None when it has been told just now."""
        node_type, node_name = message.metadata.node_type, message.metadata.node_name
        key = (message.sender_type, message.sender_id, node_type, node_name, kind)
        now = self._now()
        with self._lock:
            if self._told.get(key, -AGAIN_S) + AGAIN_S > now:
                return None
            self._told[key] = now
            self._told.move_to_end(key)
            if len(self._told) > REMEMBERED:
                self._told.popitem(last=False)
        return DataRefused(
            robot_id=robot_id, node_type=node_type, node_name=node_name, tos_name=topic, kind=kind, reason=reason
        )
