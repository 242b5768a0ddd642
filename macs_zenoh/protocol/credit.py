"""How much somebody may send: credit that is earned with time, and what of it survives a reconnection. Pure."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

Address = TypeVar("Address", bound=Hashable)


class Credit:
    """So many frames per second, at once ``most`` of them or a second's worth; 0 is no limit."""

    def __init__(
        self, frames_per_s: float, now: float, left: float | None = None, *, most: float | None = None
    ) -> None:
        self.frames_per_s = frames_per_s
        self._most = max(1.0, frames_per_s if most is None else most)
        self._left = self._most if left is None else left
        self._at = now

    def left(self, now: float) -> float:
        """How many frames it is worth."""
        earned = max(0.0, now - self._at) * self.frames_per_s
        self._left, self._at = min(self._most, self._left + earned), max(self._at, now)
        return self._left

    def take(self, frames: float, now: float) -> bool:
        """Take so many frames, if they are covered."""
        if not self.frames_per_s:
            return True
        if self.left(now) < frames:
            return False
        self._left -= frames
        return True


class Credits(Generic[Address]):
    """What connections that have ended left over, by address: who connects again goes on with that.

    Kept as long as it is less than a new one would get, which is a second at most.
    """

    ADDRESSES = 4096
    PER_ADDRESS = 64

    def __init__(self, frames_per_s: float) -> None:
        self.frames_per_s = frames_per_s
        self._left: OrderedDict[Address, list[Credit]] = OrderedDict()
        """By address, the one that ended longest ago first."""
        self._ended: dict[Address, float] = {}

    def enter(self, address: Address, now: float) -> Credit:
        """The credit of a new connection: the smallest that there is."""
        waiting = self._left.get(address)
        if not waiting:
            return Credit(self.frames_per_s, now)
        smallest = min(waiting, key=lambda credit: credit.left(now))
        waiting.remove(smallest)
        return smallest

    def leave(self, address: Address, credit: Credit, now: float) -> None:
        """A connection has ended."""
        if not self.frames_per_s:
            return
        waiting = self._left.setdefault(address, [])
        waiting.append(credit)
        del waiting[: -self.PER_ADDRESS]
        self._left.move_to_end(address)
        self._ended[address] = now
        while len(self._left) > self.ADDRESSES or self._ended[next(iter(self._left))] < now - 1.0:
            forgotten, _ = self._left.popitem(last=False)  # all of it is full again after a second
            del self._ended[forgotten]
