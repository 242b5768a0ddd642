"""Holding senders back while what they send to is full.

Only for a moment: an existing headset freezes when nobody reads from it. A receiver that is merely slower than a
burst gets the time it needs; one that has stopped reading costs each sender this moment once, and then its own limits
decide.
"""

from __future__ import annotations

import asyncio
import time
from typing import Protocol

HOLD_S = 0.25


class Sender(Protocol):
    """What can be held back."""

    def pause(self) -> None:
        """Stop reading from it."""

    def resume(self) -> None:
        """Read again. Pauses and resumes are counted."""


class Backpressure:
    """One bottleneck, and the senders that wait for it."""

    def __init__(self) -> None:
        self._full_since: float | None = None
        self._held: set[Sender] = set()
        self._timer: asyncio.TimerHandle | None = None

    def hold(self, sender: Sender) -> None:
        """Hold a sender back until `release`, but not beyond ``HOLD_S`` since the bottleneck became full."""
        now = time.monotonic()
        if self._full_since is None:
            self._full_since = now
            self._timer = asyncio.get_running_loop().call_later(HOLD_S, self._let_go)
        if now - self._full_since < HOLD_S and sender not in self._held:
            self._held.add(sender)
            sender.pause()

    def release(self) -> None:
        """There is room again."""
        if self._full_since is not None:
            self._full_since = None
            if self._timer is not None:
                self._timer.cancel()
            self._let_go()

    def _let_go(self) -> None:
        held, self._held = self._held, set()
        for sender in held:
            sender.resume()
