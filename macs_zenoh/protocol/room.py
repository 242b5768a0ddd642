"""Room for claims by token, of which who makes up sessions has no end: which count and which are left out. Pure.

Of those who claim the same the smallest Zenoh ids count, so that all who see them all see the same; one session has so
many claims, and the last quarter of all is for those who have few. One's own always count. Whatever is left out is
still on the mesh: when there is room again (`Room.is_made`) the tokens have to be asked for anew.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Hashable
from typing import Generic, TypeVar

from .budget import may_have_one_more

T = TypeVar("T", bound=Hashable)


class Room(Generic[T]):
    """For claims of anything: ``sessions`` that claim the same, ``each`` of one session, ``total`` of all. ``mine`` is
    the own Zenoh id. Who holds what is kept by who asks."""

    def __init__(self, mine: str, *, sessions: int, each: int, total: int) -> None:
        self.left_out = 0
        """How often a claim was."""
        self._mine = mine
        self._sessions = sessions
        self._each = each
        self._total = total
        self._of: Counter[str] = Counter()
        self._used = 0
        self._crowded: set[T] = set()
        self._greedy: set[str] = set()
        self._full = False
        self._made = False

    def take(self, what: T, zid: str, holders: Collection[str], *, always: bool = False) -> str | None:
        """A session claims what these others hold. Returns whose claim is left out: its own, or that of another which
        has to make room; None if nobody's is. ``always``: it counts, whoever else has how many."""
        out = None if always or zid == self._mine else self._too_many(what, zid, holders)
        if out is not None:
            self.left_out += 1
        if out != zid:
            self._count(zid, 1)
            if out is not None:
                self._count(out, -1)
        return out

    def release(self, what: T, zid: str) -> None:
        """A claim that counted has ended."""
        self._count(zid, -1)
        if what in self._crowded or zid in self._greedy or self._full:
            self._crowded.discard(what)
            self._greedy.discard(zid)
            self._full = False
            self._made = True

    def is_made(self) -> bool:
        """Whether there may be room for something that was left out, since this was last asked."""
        made, self._made = self._made, False
        return made

    def _too_many(self, what: T, zid: str, holders: Collection[str]) -> str | None:
        theirs = self._of.get(zid, 0)
        if theirs >= self._each:
            self._greedy.add(zid)
            return zid
        if len(holders) >= self._sessions:
            self._crowded.add(what)
            return max([zid, *(holder for holder in holders if holder != self._mine)])
        if not may_have_one_more(self._used, theirs, each=self._each, total=self._total):
            self._full = True
            return zid
        return None

    def _count(self, zid: str, change: int) -> None:
        self._used += change
        self._of[zid] += change
        if not self._of[zid]:
            del self._of[zid]
