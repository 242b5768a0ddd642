"""Holding senders back while what they send to is full.

Only for a moment at a time: an existing headset freezes when nobody reads from it. A receiver that is merely slower
gets the time it needs, with some frames in between. So does one that stands still, for a second, as Wi-Fi and busy
machines do; one that has stopped reading costs each sender that once, and then its own limits decide.
"""

from __future__ import annotations

import asyncio
from typing import Protocol

HOLD_S = 0.25
ROBOT_HOLD_S = 1.0
"""Of a robot program, which draws nothing that would freeze, and whose topics would be dropped at once."""
STOPPED_S = 1.0
"""A bottleneck that has not moved for so long has stopped."""


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
        self._still_since = 0.0
        """Since when it has been there, as far as is known."""
        self._held: set[Sender] = set()
        self._timer: asyncio.TimerHandle | None = None

    @property
    def holds(self) -> bool:
        """Whether senders wait, or have just been told to."""
        return self._timer is not None

    def hold(self, sender: Sender, moved: object, most_s: float = HOLD_S) -> bool:
        """Hold a sender back until `release`, but not longer than ``most_s``, and not again when the bottleneck has
        stopped: ``moved`` is another one whenever it has moved. Returns whether it is held."""
        if self._timer is None:
            loop = asyncio.get_running_loop()
            if moved != self._moved:
                self._moved, self._still_since = moved, loop.time()
            elif loop.time() - self._still_since >= STOPPED_S:
                return False
            self._timer = loop.call_later(most_s, self.release)
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
