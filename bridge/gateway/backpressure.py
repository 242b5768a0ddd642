"""Holding senders back while what they send to is full.

Only for a moment at a time: an existing headset freezes when nobody reads from it. A receiver that is merely slower
gets the time it needs, with some frames in between; one that has stopped reading costs each sender this moment once,
and then its own limits decide.
"""

from __future__ import annotations

import asyncio
from typing import Protocol

HOLD_S = 0.25
ROBOT_HOLD_S = 1.0
"""Of a robot program, which draws nothing that would freeze, and whose topics would be dropped at once."""


class Sender(Protocol):
    """What can be held back."""

    def pause(self) -> None:
        """Stop reading from it."""

    def resume(self) -> None:
        """Read again. Pauses and resumes are counted."""


class Backpressure:
    """One bottleneck, and the senders that wait for it."""

    def __init__(self) -> None:
        self._moved: object = None
        """How far the bottleneck was when senders were held last."""
        self._held: set[Sender] = set()
        self._timer: asyncio.TimerHandle | None = None

    @property
    def holds(self) -> bool:
        """Whether senders wait, or have just been told to."""
        return self._timer is not None

    def hold(self, sender: Sender, moved: object, most_s: float = HOLD_S) -> bool:
        """Hold a sender back until `release`, but not longer than ``most_s``, and not again before the bottleneck has
        moved, which ``moved`` tells: it is another one then. Returns whether it is held."""
        if self._timer is None:
            if moved == self._moved:
                return False
            self._moved = moved
            self._timer = asyncio.get_running_loop().call_later(most_s, self.release)
        if sender not in self._held:
            self._held.add(sender)
            sender.pause()
        return True

    def release(self) -> None:
        """There is room again, or they have waited long enough."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        held, self._held = self._held, set()
        for sender in held:
            sender.resume()
