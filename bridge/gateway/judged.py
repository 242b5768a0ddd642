"""Frames of this gateway's agents on their way to others of this gateway: judged once, on the way in."""

from __future__ import annotations

from macs_zenoh.mesh import Payload
from macs_zenoh.protocol.messages import Metadata
from macs_zenoh.protocol.wire import Frames

Read = list[tuple[Frames, Metadata]]
"""The frames of a sample, each with its metadata."""


class JudgedFrames:
    """By the payload itself, which is kept as long: our own subscriptions get the very object that was put."""

    MOST = 4096
    """More do not wait on the loop; what is left over by then is not going to be asked for."""
    PAYLOAD_BYTES = 128 << 10
    """Of larger ones it is nothing to judge them again."""

    def __init__(self) -> None:
        self._waiting: dict[int, tuple[Payload, Read, int]] = {}

    def note(self, payload: Payload, read: Read, copies: int, *, alone: bool) -> None:
        """So many of our subscriptions are going to get a payload; ``alone`` when none waits that was put before."""
        if alone or len(self._waiting) >= self.MOST:
            self._waiting.clear()  # of what is still there, receivers have left
        if len(payload) <= self.PAYLOAD_BYTES:
            self._waiting[id(payload)] = payload, read, copies

    def take(self, payload: Payload) -> Read | None:
        """What was noted of a payload: once for each copy."""
        noted = self._waiting.get(id(payload))
        if noted is None or noted[0] is not payload:
            return None
        _, read, copies = noted
        if copies > 1:
            self._waiting[id(payload)] = payload, read, copies - 1
        else:
            del self._waiting[id(payload)]
        return read
