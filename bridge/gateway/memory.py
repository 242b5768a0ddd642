"""What all connections of a gateway share: room in memory, and turns of the loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

from macs_zenoh.protocol.budget import Budget, Unfinished
from macs_zenoh.protocol.limits import UNFINISHED_FREE_BYTES, UNFINISHED_IN_ALL_BYTES, WAITING_IN_ALL_BYTES

from .shares import Rounds

if TYPE_CHECKING:
    from .connection import Connection


class Memory:
    """Bytes that wait for those who read slowly, and of frames that have begun. One frame of the largest size and what
    one connection may keep always have room."""

    def __init__(self, outbox_bytes: int, max_frame_bytes: int) -> None:
        most = 2 * max_frame_bytes + outbox_bytes
        total = max(WAITING_IN_ALL_BYTES, 2 * most)
        self.waiting = Budget("bytes waiting for them", each=most, per_address=total - total // 4, total=total)
        total = max(UNFINISHED_IN_ALL_BYTES, 2 * max_frame_bytes)
        self.unfinished: Unfinished[Connection] = Unfinished(UNFINISHED_FREE_BYTES, total)
        self.rounds = Rounds()
        """Who waits for his turn to be read from."""
