"""Who serves what on this robot: services and actions, as ROS tells."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from bridge.ros.side import Side
from bridge.ros.types import InterfaceName

ABSENT_S = 2.0
"""How long a call waits for a service that is not there: one that has just started is found within this, also on a
busy machine. At most half of the call's own time."""
LOOK_S = 0.02
"""Pause between looks for it; ROS tells nobody when a service appears."""
KNOWN_S = 0.15
"""How long a service that we have found may need to find us."""


class Search:
    """Looks for a server: ``ready`` tells whether its side of everything is known here."""

    def __init__(self, ready: Callable[[], bool]) -> None:
        self._ready = ready
        self._known_at: float | None = None

    async def found(self, within_s: float) -> bool:
        """Whether it is there, and knows us: it finds out later than we do, and its answers would be lost."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + within_s
        while not self._ready():
            self._known_at = None
            if loop.time() > deadline:
                return False
            await asyncio.sleep(LOOK_S)
        if self._known_at is None:
            self._known_at = loop.time() + KNOWN_S
        if (wait_s := self._known_at - loop.time()) > 0:
            await asyncio.sleep(wait_s)
        return True


def check_service_type(side: Side, service: str, interface: InterfaceName) -> bool:
    """Whether the service exists. Raises Refused when it has another type. In the ROS thread."""
    types = dict(side.services()).get(service, [])
    interface.check(service, types)
    return bool(types) and side.count_servers(service) > 0
