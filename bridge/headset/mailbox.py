"""A bounded queue between the one task that reads a socket and whoever takes the messages."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")

_PATIENCE = 3
"""Turns of the event loop that `Mailbox.offer` waits for room: a waiting taker wakes within two."""


class Mailbox(Generic[T]):
    """Holds at most ``size`` items; when full drops the oldest, or the newest if ``drop_new``, and counts it.

    Iterating takes items in order and ends after `close`, when what was there has been taken. One taker at a time.
    """

    def __init__(self, size: int, *, drop_new: bool = False) -> None:
        self.size = max(1, size)
        self.drop_new = drop_new
        self.dropped = 0
        self._items: deque[T] = deque()
        self._closed = False
        self._taker: asyncio.Future[None] | None = None

    def __len__(self) -> int:
        return len(self._items)

    async def offer(self, item: T) -> None:
        """Put one item, after giving a taker that only waits for its turn the chance to make room."""
        for _ in range(_PATIENCE):
            if len(self._items) < self.size:
                break
            await asyncio.sleep(0)
        self.put(item)

    def put(self, item: T) -> None:
        """Put one item now."""
        if len(self._items) >= self.size:
            self.dropped += 1
            if self.drop_new:
                return
            self._items.popleft()
        self._items.append(item)
        self._wake()

    def close(self) -> None:
        """No more items will come."""
        self._closed = True
        self._wake()

    def __aiter__(self) -> Mailbox[T]:
        return self

    async def __anext__(self) -> T:
        while not self._items:
            if self._closed:
                raise StopAsyncIteration
            self._taker = asyncio.get_running_loop().create_future()
            await self._taker
        return self._items.popleft()

    def _wake(self) -> None:
        if self._taker is not None and not self._taker.done():
            self._taker.set_result(None)
