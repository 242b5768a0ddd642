"""Answers with this machine's time: the asker learns how far their clocks are apart, and how long the way is."""

from __future__ import annotations

import time

from msgspec import Struct

from macs_zenoh.errors import Refused
from macs_zenoh.managers import Asker, Manager


class Comparison(Struct, rename="camel"):
    """The answer: what was sent, and this machine's time, both in seconds since 1970."""

    sent_at_s: float
    received_at_s: float
    asker: str


class ClockComparer(Manager):
    """``{"messageManager": "ClockComparer", "sentAtS": 1760000000.25}`` → a `Comparison`."""

    class Data(Struct, rename="camel"):
        """What the asker sends: its own time in seconds since 1970."""

        sent_at_s: float

    def manage(self, data: Data, asker: Asker) -> Comparison:
        """Answer at once. Raises Refused for a time that no clock shows."""
        if data.sent_at_s <= 0:
            raise Refused(f"{data.sent_at_s} is not a time")
        return Comparison(data.sent_at_s, time.time(), f"{asker.type}/{asker.id}")
