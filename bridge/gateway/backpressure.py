"""Holding senders back while what they send to is full.

Only for a moment at a time: an existing headset freezes when nobody reads from it. A receiver that is merely slower
gets the time it needs, with some frames in between. So does one that stands still, for a second, as Wi-Fi and busy
machines do; one that has stopped reading costs each sender that once, and then its own limits decide. Several that
stand still cost a sender no more together: a stop may be behind what it sends them.
"""

from __future__ import annotations

import asyncio
import math
from typing import Protocol

HOLD_S = 0.25
ROBOT_HOLD_S = 1.0
"""Of a robot program, which draws nothing that would freeze, and whose topics would be dropped at once."""
STOPPED_S = 1.0
"""A bottleneck that has not moved for so long has stopped."""


HELD_S = 1.0
"""So long at most a sender is held in all by what has not moved since, until it was not for `CALM_S`."""
CALM_S = 5.0


class Patience:
    """How long a sender was held by what has not moved since."""

    def __init__(self) -> None:
        self._held_s = 0.0
        self._until = -math.inf
        """When the last time ends, or has ended."""

    def take(self, most_s: float, now: float, *, moves: bool) -> float | None:
        """It is to be held for so long: how much longer that is than it is held anyway. None: it was long enough, for
        what does not move."""
        if now >= self._until + CALM_S:
            self._held_s = 0.0
        until = max(self._until, now + most_s)
        if until > self._until and self._held_s >= HELD_S and not moves:
            return None
        costs_s, self._until = until - max(now, self._until), until
        self._held_s += costs_s
        return costs_s

    def give_back(self, held_s: float) -> None:
        """What held it has moved."""
        self._held_s = max(0.0, self._held_s - held_s)


class Sender(Protocol):
    """What can be held back."""

    @property
    def patience(self) -> Patience | None:
        """None: somebody else sees to it that it is not held for too long."""

    def pause(self) -> None:
        """Stop reading from it."""

    def resume(self) -> None:
        """Read again. Pauses and resumes are counted."""


class Backpressure:
    """One bottleneck, and the senders that wait for it."""

    def __init__(self) -> None:
        self._moved: object = None
        """How far the bottleneck was when it was looked at last."""
        self._looked_at = -math.inf
        self._moves = False
        """Whether it had moved then, since it was looked at a moment before."""
        self._still_since = 0.0
        """Since when it has been there, as far as is known."""
        self._held: set[Sender] = set()
        self._took: list[tuple[Patience, float]] = []
        """From whom, since it has moved, and how much."""
        self._timer: asyncio.TimerHandle | None = None

    @property
    def holds(self) -> bool:
        """Whether senders wait, or have just been told to."""
        return self._timer is not None

    def hold(self, sender: Sender, moved: object, most_s: float = HOLD_S) -> bool:
        """Hold a sender back until `release`, but not longer than ``most_s``, and not again when the bottleneck has
        stopped: ``moved`` is another one whenever it has moved. Nor if nobody knows that it moves, when others that
        stand still have held the sender long enough. Returns whether it is held."""
        if sender in self._held:
            return True
        loop = asyncio.get_running_loop()
        now = loop.time()
        if self._timer is None:
            self._look(moved, now)
            if now - self._still_since >= STOPPED_S:
                return False
        if not self._takes(sender, most_s if self._timer is None else self._timer.when() - now, now):
            return False
        if self._timer is None:
            self._timer = loop.call_later(most_s, self._let_go)
        self._held.add(sender)
        sender.pause()
        return True

    def release(self) -> None:
        """There is room again."""
        self.has_moved()
        self._let_go()

    def has_moved(self) -> None:
        """It does not stand still: what it has held anybody does not count."""
        took, self._took = self._took, []
        for patience, held_s in took:
            patience.give_back(held_s)

    def _look(self, moved: object, now: float) -> None:
        self._moves = moved != self._moved and now < self._looked_at + CALM_S
        self._looked_at = now
        if moved != self._moved:
            self.has_moved()
            self._moved, self._still_since = moved, now

    def _takes(self, sender: Sender, most_s: float, now: float) -> bool:
        """Whether a sender may be held for so long."""
        if (patience := sender.patience) is not None:
            if (costs_s := patience.take(most_s, now, moves=self._moves)) is None:
                return False
            self._took.append((patience, costs_s))
        return True

    def _let_go(self) -> None:
        """They have waited long enough."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        held, self._held = self._held, set()
        for sender in held:
            sender.resume()
