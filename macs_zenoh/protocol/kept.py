"""What was said on a connection and may not have arrived: numbered, and kept within bounds. Pure.

A socket that is cut takes with it what was on its way, and nobody can tell how much. So both ends of a session number
what they say, and count what they hear. Who comes back tells how far he had heard; the other goes on behind that, with
what it has kept. Not all is kept: topics and commands have newer ones, so they are only counted.
"""

from __future__ import annotations

from collections import deque
from typing import Generic, TypeVar

Said = TypeVar("Said")


class Room:
    """What all of a gateway's sessions keep together, in bytes."""

    def __init__(self, most_bytes: int) -> None:
        self.most_bytes = most_bytes
        self.bytes = 0


class Kept(Generic[Said]):
    """One end's, of one session. The first thing that it says is number 1.

    ``most_bytes`` and ``most`` bound it; where all together have more than ``room`` allows, those give way that keep
    more than ``FAIR_BYTES``.
    """

    FAIR_BYTES = 16 << 10

    def __init__(self, most_bytes: int, most: int, room: Room | None = None) -> None:
        self.number = 0
        """Of the last thing that was said."""
        self.bytes = 0
        self._most_bytes = most_bytes
        self._most = most
        self._room = room or Room(most_bytes)
        self._said: deque[tuple[int, Said, int]] = deque()
        self._given_up = 0
        """Number of the last that had to give way."""

    def __len__(self) -> int:
        return len(self._said)

    def put(self, said: Said, size: int) -> None:
        """This is said now, and kept until it has arrived; of what is larger than all may have, and of the oldest,
        only the number."""
        self.number += 1
        self._said.append((self.number, said, size))
        self._count(size)
        while self.bytes > self._most_bytes or len(self._said) > self._most or self._is_unfair():
            self._given_up, _, size = self._said.popleft()
            self._count(-size)

    def skip(self, count: int = 1) -> None:
        """So much is said that is not kept."""
        self.number += count

    def arrived(self, number: int) -> None:
        """The other end has heard all up to this number."""
        while self._said and self._said[0][0] <= number:
            *_, size = self._said.popleft()
            self._count(-size)

    def again(self, number: int) -> tuple[list[Said], bool]:
        """What is to be said again to who has heard up to this number, behind which the next is numbered; and whether
        something is missing of it that had been kept."""
        number = min(number, self.number)
        self.arrived(number)
        missing = self._given_up > number
        said = [each for _, each, _ in self._said]
        self.clear()
        self.number, self._given_up = number, 0
        return said, missing

    def clear(self) -> None:
        """Nobody is going to ask for it."""
        self._said.clear()
        self._count(-self.bytes)

    def _is_unfair(self) -> bool:
        return self._room.bytes > self._room.most_bytes and self.bytes > self.FAIR_BYTES

    def _count(self, change: int) -> None:
        self.bytes += change
        self._room.bytes += change
