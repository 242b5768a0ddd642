"""Connections for which there is no id yet. They wait in turn and not for ever, and it is said that they do."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Iterator

from .connection import Connection

log = logging.getLogger("macs.gateway")

NAMED_S = 2.0
"""Who waits longer than this is named in the log."""


class WaitingRoom:
    """First come, first served. Who has waited for ``patience_s`` is handed to ``on_patience_ends``."""

    def __init__(self, patience_s: float, on_patience_ends: Callable[[Connection], None]) -> None:
        self._patience_s = patience_s
        self._on_patience_ends = on_patience_ends
        self._since: dict[Connection, float] = {}
        self._named: set[Connection] = set()
        self._timer: asyncio.TimerHandle | None = None

    def __len__(self) -> int:
        return len(self._since)

    def __iter__(self) -> Iterator[Connection]:
        return iter(list(self._since))

    @property
    def longest_s(self) -> float:
        """How long the first one waits."""
        return time.monotonic() - next(iter(self._since.values())) if self._since else 0.0

    def enter(self, connection: Connection) -> None:
        """A connection waits from now on."""
        self._since[connection] = time.monotonic()
        self._schedule()

    def next(self) -> Connection:
        """Whose turn it is, who waits no longer."""
        connection = next(iter(self._since))
        self.leave(connection)
        return connection

    def leave(self, connection: Connection) -> None:
        """A connection does not wait any more, if it did."""
        self._since.pop(connection, None)
        self._named.discard(connection)

    def close(self) -> None:
        """Nobody waits here any more."""
        self._since.clear()
        if self._timer is not None:
            self._timer.cancel()

    def _schedule(self) -> None:
        if self._timer is None and self._since:
            self._timer = asyncio.get_running_loop().call_later(NAMED_S / 4, self._look)

    def _look(self) -> None:
        self._timer = None
        now = time.monotonic()
        late = [c for c, since in self._since.items() if now - since > NAMED_S and c not in self._named]
        if late:
            self._named.update(late)
            names = ", ".join(c.address for c in late[:5]) + (" …" if len(late) > 5 else "")
            log.warning("%d connections wait for an id, longer than %g s: %s", len(self), NAMED_S, names)
        for connection in [c for c, since in self._since.items() if now - since > self._patience_s]:
            self._on_patience_ends(connection)
        self._schedule()
