"""Commands that have waited in their connection: of each kind the newest goes on, when none has come for a moment."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable

from macs_zenoh.protocol.rate_limit import TOGETHER_S
from macs_zenoh.protocol.tcp_agent import Sent

from .connection import Connection
from .routes import Route


class Latest:
    """Of all connections of a gateway. ``put`` sends a command on its way."""

    def __init__(self, put: Callable[[Route, Sent], None]) -> None:
        self._put = put
        self._held: dict[Connection, dict[Hashable, tuple[Route, Sent, asyncio.TimerHandle]]] = {}

    def hold(self, connection: Connection, kind: Hashable, route: Route, newest: Sent) -> bool:
        """Let a command wait for a newer one. Whether one did that is now dropped."""
        held = self._held.setdefault(connection, {})
        superseded = held.pop(kind, None)
        if superseded is not None:
            superseded[-1].cancel()
        timer = asyncio.get_running_loop().call_later(TOGETHER_S, self._go, connection, kind)
        held[kind] = route, newest, timer
        return superseded is not None

    def follow(self, connection: Connection, kind: Hashable) -> None:
        """A command has come that has not waited: nor has the one before it, which goes on first."""
        if kind in self._held.get(connection, ()):
            self._go(connection, kind)

    def drop(self, connection: Connection, kind: Hashable) -> bool:
        """What waits is not to go on, since something newer does. Whether anything did."""
        dropped = self._held.get(connection, {}).pop(kind, None)
        if dropped is None:
            return False
        dropped[-1].cancel()
        if not self._held[connection]:
            del self._held[connection]
        return True

    def go(self, connection: Connection) -> None:
        """Nothing newer can come: the connection has ended, or is about to have another id."""
        for kind in [*self._held.get(connection, ())]:
            self._go(connection, kind)
        self._held.pop(connection, None)

    def close(self) -> None:
        """Nothing goes on any more."""
        for held in self._held.values():
            for *_, timer in held.values():
                timer.cancel()
        self._held.clear()

    def _go(self, connection: Connection, kind: Hashable) -> None:
        held = self._held[connection]
        route, newest, timer = held.pop(kind)
        timer.cancel()
        if not held:
            del self._held[connection]
        self._put(route, newest)
