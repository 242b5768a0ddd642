"""How much an interface node of a topic has carried."""

from __future__ import annotations

import time

from macs_zenoh.protocol.robot_state import CarriedStatus


class Carried:
    """Messages of one topic, their bytes of CDR, and when the last one was. From any thread; of two that count in the
    same moment one may be missed."""

    __slots__ = ("bytes", "last_s", "messages")

    def __init__(self) -> None:
        self.messages = 0
        self.bytes = 0
        self.last_s = 0.0

    def count(self, size: int) -> None:
        """One more."""
        self.messages += 1
        self.bytes += size
        self.last_s = time.monotonic()

    def status(self) -> CarriedStatus:
        """The same for others."""
        age_s = round(time.monotonic() - self.last_s, 3) if self.messages else None
        return CarriedStatus(self.messages, self.bytes, age_s)
