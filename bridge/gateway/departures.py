"""Agents that leave, many in one moment: none of them, and nobody who is told of them, takes others' turns.

What ends with a connection, and telling each agent here who has left, costs a fraction of a millisecond each. A
thousand that leave together are a second, in which the event loop does nothing else unless that is done in pieces; and
to a router they cost as much, so that they leave at its pace: when a thousand ended at once a robot's dead-man was
0.37 s late.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator

from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.registrations import AgentKey

from .connection import Connection

PIECE_S = 0.001
"""Work of so long is done at once; then others have their turn."""
AT_ONCE, EVERY_S = 2, 0.01
"""So many that others see leave, or fall asleep, in so many seconds: a router takes up to a millisecond for each, in
the thread that brings commands as well."""
MORE = 300
"""For so many that wait one more each time: what waits has an end however many come and go."""
GATHER_S = 0.02
"""Who leaves so soon after others is told of together with those that follow."""


class Pieces:
    """Connections for each of which something is done, in the order in which they came: the first at once. Then
    ``then`` is called, once for all whose turn it was."""

    def __init__(self, do: Callable[[Connection], None], then: Callable[[], None]) -> None:
        self._do = do
        self._then = then
        self._turnstile = Turnstile(self._put)
        self._waiting: deque[Connection] = deque()
        self._turn: asyncio.Handle | None = None

    def put(self, connection: Connection, *, seen: bool = False, first: bool = False) -> None:
        """One more; those that others see come later where they are many, ``first`` those that are needed."""
        if seen:
            self._turnstile.put(connection, first=first)
        else:
            self._put(connection)

    def hurry(self) -> None:
        """Nobody waits from now on."""
        self._turnstile.open()

    def _put(self, connection: Connection) -> None:
        self._waiting.append(connection)
        if self._turn is None:
            self._go_on()

    def _go_on(self) -> None:
        self._turn = None
        if not self._waiting:
            return
        self._turn = asyncio.get_running_loop().call_soon(self._go_on)  # whatever becomes of this one
        self._do_until(time.monotonic() + PIECE_S)

    def _do_until(self, until: float) -> None:
        try:
            while self._waiting and time.monotonic() < until:
                self._do(self._waiting.popleft())
        finally:
            self._then()

    def finish(self) -> None:
        """Do all that is left now."""
        self._do_until(math.inf)


class Turnstile:
    """Lets through so many connections in a second as a router can bear: at once while that is not too many, then in
    their order, ``first`` those on which something depends."""

    def __init__(self, do: Callable[[Connection], None]) -> None:
        self._do = do
        self._first: deque[Connection] = deque()
        self._others: deque[Connection] = deque()
        self._left = AT_ONCE
        self._timer: asyncio.TimerHandle | None = None
        self._is_open = False

    def put(self, connection: Connection, *, first: bool) -> None:
        """One more."""
        (self._first if first else self._others).append(connection)
        self._let_through()
        if self._timer is None and not self._is_open:
            self._timer = asyncio.get_running_loop().call_later(EVERY_S, self._again)

    def open(self) -> None:
        """Let all through from now on."""
        self._is_open = True
        if self._timer is not None:
            self._timer.cancel()
        self._let_through()

    def _let_through(self) -> None:
        while (self._left or self._is_open) and (waiting := self._first or self._others):
            self._left -= 1
            self._do(waiting.popleft())

    def _again(self) -> None:
        was_used, self._left = self._left < AT_ONCE, AT_ONCE + (len(self._first) + len(self._others)) // MORE
        self._timer = asyncio.get_running_loop().call_later(EVERY_S, self._again) if was_used else None
        self._let_through()


class Departures:
    """Tells all agents of a gateway who has left. ``telling`` makes what tells one of them."""

    def __init__(
        self,
        online: Callable[[], Iterable[Connection]],
        telling: Callable[[list[AgentInfo]], Callable[[Connection], None]],
    ) -> None:
        self._online = online
        self._make_telling = telling
        self._gone: dict[AgentKey, AgentInfo] = {}
        """Of whom nobody has been told yet."""
        self._now: frozenset[AgentKey] = frozenset()
        """Of whom some have been told."""
        self._telling: Iterator[None] | None = None
        self._timer: asyncio.Handle | None = None

    def tell(self, gone: Iterable[AgentInfo], come: Iterable[AgentKey]) -> None:
        """These have left, and those have come: who has the id of one who left comes after everybody knows of that."""
        if any(agent in self._gone or agent in self._now for agent in come):
            self.finish()
        self._gone.update((agent.key, agent) for agent in gone)
        if self._gone and self._timer is None:
            self._go_on()

    def finish(self) -> None:
        """Tell everybody now."""
        for _ in self._telling or ():
            pass
        self._telling = None
        if self._gone:
            for _ in self._tell_all():
                pass

    def close(self) -> None:
        """Tell nobody any more."""
        if self._timer is not None:
            self._timer.cancel()

    def _go_on(self) -> None:
        """Tell some of them, and rest: until others have had their turn, or until there may be more to tell."""
        loop = asyncio.get_running_loop()
        self._timer = None
        if self._telling is None:
            if not self._gone:
                return
            self._telling = self._tell_all()
        until = time.monotonic() + PIECE_S
        for _ in self._telling:
            if time.monotonic() > until:
                self._timer = loop.call_soon(self._go_on)
                return
        self._telling = None
        self._timer = loop.call_later(GATHER_S, self._go_on)

    def _tell_all(self) -> Iterator[None]:
        tell, self._now = self._make_telling(list(self._gone.values())), frozenset(self._gone)
        self._gone.clear()
        for connection in list(self._online()):
            tell(connection)
            yield
        self._now = frozenset()
