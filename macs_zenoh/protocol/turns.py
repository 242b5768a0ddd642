"""Whose call to one robot is made next, when more are wanted than may be open at one time. Pure."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")
Caller = tuple[int, int]


class Turns(Generic[K, V]):
    """Callers take turns; each has its own calls made in the order in which they were wanted, one per ``K``.

    ``each`` may be open of one caller, ``total`` of all.
    """

    def __init__(self, each: int, total: int) -> None:
        self._each = each
        self._total = total
        self._waiting: dict[Caller, dict[K, V]] = {}
        self._open: dict[Caller, int] = {}
        self.open = 0

    def __len__(self) -> int:
        return sum(map(len, self._waiting.values()))

    def put(self, caller: Caller, key: K, call: V) -> None:
        """A call is wanted. It replaces one with the same key that waits."""
        waiting = self._waiting.setdefault(caller, {})
        waiting.pop(key, None)
        waiting[key] = call

    def take(self) -> tuple[Caller, K, V] | None:
        """The next call to make now; `done` says when it has ended. None while as many are open as may be."""
        if self.open >= self._total:
            return None
        for caller in self._waiting:
            opened = self._open.get(caller, 0)
            if opened < self._each:
                break
        else:
            return None
        waiting = self._waiting.pop(caller)
        key = next(iter(waiting))
        call = waiting.pop(key)
        if waiting:
            self._waiting[caller] = waiting  # to the back
        self._open[caller] = opened + 1
        self.open += 1
        return caller, key, call

    def done(self, caller: Caller) -> None:
        """A call of this caller has ended."""
        self.open -= 1
        self._open[caller] -= 1
        if not self._open[caller]:
            del self._open[caller]

    def waits(self, caller: Caller) -> int:
        """How many calls of a caller wait."""
        return len(self._waiting.get(caller, ()))

    def drop(self, caller: Caller, key: K | None = None) -> None:
        """Calls of this caller are not wanted any more: all that wait, or one."""
        if key is None:
            self._waiting.pop(caller, None)
        elif (waiting := self._waiting.get(caller)) is not None:
            waiting.pop(key, None)
            if not waiting:
                del self._waiting[caller]
