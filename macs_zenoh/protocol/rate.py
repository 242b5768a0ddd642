"""At most so much per second, of anything. Pure: times are passed in."""

from __future__ import annotations

import math


class Rate:
    """What passes has to be paid for with time. After a pause something of any size passes; what follows waits for
    what it took. ``burst_s`` worth of it may come at once, and one more."""

    def __init__(self, per_s: float, burst_s: float = 0.0) -> None:
        self._per_s = per_s
        self._burst_s = burst_s
        self._paid_until = -math.inf

    @property
    def due(self) -> float:
        """When something may pass again."""
        return self._paid_until - self._burst_s

    def allows(self, now: float) -> bool:
        """Whether anything may pass now."""
        return self._paid_until - now <= self._burst_s

    def take(self, amount: float, now: float) -> None:
        """Something passes."""
        self._paid_until = max(self._paid_until, now) + amount / self._per_s
