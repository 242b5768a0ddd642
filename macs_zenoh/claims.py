"""Claims by token: ids, blocks and names that must be one session's alone. Asyncio; `protocol.ids` has the rules.

Who claims something declares a token for it, waits until somebody else's would have shown up, and keeps it where it
has the older right. When two parts of a mesh meet, several may hold what each had alone.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection, Mapping
from typing import Generic, TypeVar

from .config import MeshSettings
from .deadline import Deadline
from .protocol.ids import Contests, Verdict, keeps

SETTLE_S = 0.3
"""How long a claim waits for somebody else's on the same to show up."""

T = TypeVar("T")


async def settle(mine: str, holders: Callable[[], Collection[str]]) -> bool:
    """Wait until all that claimed the same in this moment are seen, and tell whether it is ours (``mine``, of all
    Zenoh ids in ``holders``)."""
    await asyncio.sleep(SETTLE_S)
    return keeps(mine, holders())


def stale_until(settings: MeshSettings) -> float:
    """When the token of an earlier life of this program, whose session did not close, is gone for sure."""
    return time.monotonic() + settings.lease_ms / 1000 + 1.0


class Disputes(Generic[T]):
    """What of ours others hold as well, and when something is to be done about it: then ``on_verdicts`` hears it."""

    def __init__(self, contests: Contests[T], on_verdicts: Callable[[list[Verdict[T]]], None]) -> None:
        self._contests = contests
        self._on_verdicts = on_verdicts
        self._deadline = Deadline(self._judge)

    def __contains__(self, what: object) -> bool:
        return what in self._contests

    def look(self, contested: Mapping[T, Collection[str]]) -> list[T]:
        """All that is contested now, with the others' Zenoh ids. Returns what is so no longer."""
        over = self._contests.look(contested, time.monotonic())
        self._judge()
        return over

    def close(self) -> None:
        """Judge no more."""
        self._deadline.cancel()

    def _judge(self) -> None:
        verdicts = self._contests.judge(time.monotonic())
        self._deadline.set(self._contests.next_deadline())
        if verdicts:
            self._on_verdicts(verdicts)
