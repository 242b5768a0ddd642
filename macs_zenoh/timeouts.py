"""A limit of time for what is awaited."""

from __future__ import annotations

import sys
import time
from collections.abc import Awaitable
from typing import TypeVar

if sys.version_info >= (3, 11):
    from asyncio import timeout
else:
    from async_timeout import timeout

T = TypeVar("T")


class Deadline:
    """A limit of time, in seconds, for several waits that come one after the other."""

    def __init__(self, timeout_s: float) -> None:
        self.timeout_s = timeout_s
        self._at = time.monotonic() + timeout_s

    @property
    def left_s(self) -> float:
        """How long may still be waited. Below 0 it is over."""
        return self._at - time.monotonic()


async def within(awaitable: Awaitable[T], timeout_s: float | None) -> T:
    """The result of what is awaited. Raises asyncio.TimeoutError when there is none after ``timeout_s``, in seconds.

    Before Python 3.12 ``asyncio.wait_for`` swallows a cancellation that comes when what it waits for has just ended
    (python/cpython#86296): whoever was to be stopped goes on for ever.
    """
    async with timeout(timeout_s):
        return await awaitable
