"""What a gateway tells who asks by a ping for its agents."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator

from macs_zenoh.protocol.ping import GatewayAgent, encode_told

from .agents import Agents

GOOD_S = 0.25
"""So long all who ask are told the same: of many agents it takes longer than many frames."""


class Told:
    """Its agents, and what was lost."""

    def __init__(self, agents: Agents, drops: Callable[[], Counter[str]]) -> None:
        """``drops``: what was lost, but for those who are connected."""
        self._agents = agents
        self._drops = drops
        self._at = -math.inf
        self._last = b""

    def now(self) -> bytes:
        """`ping.encode_told` of it."""
        now = time.monotonic()
        if now - self._at > GOOD_S:
            lost = self._drops()
            for connection in self._agents.connections():
                lost.update(connection.all_drops())
            self._at, self._last = now, encode_told(self._each(now), lost)
        return self._last

    def _each(self, now: float) -> Iterator[GatewayAgent]:
        for connection in self._agents.online():
            age_s = round(now - connection.greeted_at, 1)
            yield GatewayAgent(*connection.key, connection.address, connection.peer.grant.name, age_s)
