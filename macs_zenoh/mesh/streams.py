"""Topic data that a program puts for others: what is large of it holds up nobody else's."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from macs_zenoh.handles import Callbacks, Handle
from macs_zenoh.losses import Losses

from .declared import Payload, Traffic
from .loopback import Loopback
from .sender import Sender, is_large

if TYPE_CHECKING:
    from .outgoing import Outgoing


class Streams:
    """That of one session. On a full link Zenoh waits for room for each fragment, so a thread puts what is large, and
    what follows it with its key. Whoever brings it is held back while `backlogged`."""

    MOST_BYTES = 16 << 20
    """So much may wait; of what others wait behind, no longer than ``MOST_S``: newer data follows."""
    MOST_S = 0.5

    def __init__(
        self,
        outgoing: Outgoing,
        loopback: Loopback,
        drops: Losses,
        from_thread: Callable[[Callable[[], None]], None],
        on_late: Callable[[], None],
    ) -> None:
        self._outgoing = outgoing
        self._on_room: Callbacks[Callable[[], None]] = Callbacks()
        room = partial(from_thread, self._room)
        self.sender = Sender(self.MOST_BYTES, loopback.put, room, drops, on_late, self.MOST_S)

    def put(self, key: str, payload: Payload) -> None:
        """Publish. On the loop."""
        by_thread = is_large(payload) or self.sender.has(key)
        if not (by_thread and self._outgoing.put_by(self.sender, key, payload, Traffic.STREAM)):
            self._outgoing.put(key, payload, Traffic.STREAM)

    def put_here(self, key: str, payload: Payload, *, ruled: bool = True, traced: bool = True) -> bool:
        """Publish in this thread, whichever it is. False: it is lost already, and counted. Without ``ruled`` it passes
        traffic rules, and uses up nothing of them; without ``traced`` it is in no trace."""
        return self._outgoing.put(key, payload, Traffic.STREAM, ruled=ruled, traced=traced)

    @property
    def backlogged(self) -> bool:
        """Whether so much waits that who brings more should be held back; `on_room` tells when it is over."""
        return self.sender.backlogged

    @property
    def sent(self) -> int:
        """How many of what had to wait were put."""
        return self.sender.sent

    def on_room(self, callback: Callable[[], None]) -> Handle:
        """Call ``callback`` whenever a backlog has gone."""
        return self._on_room.add(callback)

    def when_sent(self, callback: Callable[[], None]) -> None:
        """`Sender.when_sent`."""
        self.sender.when_sent(callback)

    def _room(self) -> None:
        for callback in self._on_room:
            callback()
