"""What one TCP agent sends to robots: how much of it is passed on, and which commands have waited. Pure.

A robot drops what is too much for it, but on the way there it would fill the links that others' stops go over. And
only the gateway can see that commands waited in the agent's own connection: a headset whose Wi-Fi stood still for a
minute sends all that it said meanwhile at once, and no stamp tells how old it is. So after a gap in a flow of
commands, of those that come together only the newest of each kind goes on.
"""

from __future__ import annotations

import math
from enum import Enum

from .credit import Credit


class Passing(Enum):
    """What becomes of a frame."""

    NOW = "now"
    FLOODED = "flooded"
    """More than the agent may send."""
    WAITED = "waited"
    """It has waited: only the newest of its kind goes on, when the rest of what came with it has been seen."""


NOW, FLOODED, WAITED = Passing.NOW, Passing.FLOODED, Passing.WAITED


class Pace:
    """Of one connection."""

    FLOW = 5
    """So many commands, each soon after the one before, are a flow: somebody drives."""
    LEAST_S, MOST_S = 0.002, 0.5
    """What comes faster is a burst, as programs send it that have several things to say; what comes slower no flow."""
    GAP_S = 1.0
    """A flow that has a gap of so long has stood still, or somebody has stopped driving for a moment."""
    TOGETHER_S = 0.05
    LATE_S = 1.0
    """For so long at most commands count as having waited."""

    def __init__(self, commands_per_s: float, requests_per_s: float, now: float) -> None:
        self._commands = Credit(commands_per_s, now)
        self._requests = Credit(requests_per_s, now)
        self._last = -math.inf
        self._flow = 0
        self._late_since: float | None = None

    def request(self, count: int, now: float) -> Passing:
        """Of so many messages that are no commands."""
        return NOW if self._requests.take(count, now) else FLOODED

    def command(self, count: int, now: float, *, may_stop: bool = False) -> Passing:
        """Of so many commands that came together. One that may be an emergency stop is never held back."""
        gap, self._last = now - self._last, now
        if may_stop:
            return NOW
        if not self._commands.take(count, now):
            return FLOODED
        if self._late_since is not None:
            if gap < self.TOGETHER_S and now - self._late_since < self.LATE_S:
                return WAITED
            self._late_since = None
        if gap > self.GAP_S and self._flow >= self.FLOW:
            self._flow, self._late_since = 0, now
            return WAITED
        if count > 1 or gap < self.LEAST_S or gap > self.MOST_S:
            self._flow = 0
        else:
            self._flow += 1
        return NOW
