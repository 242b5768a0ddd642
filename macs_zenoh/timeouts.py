"""A limit of time for what is awaited."""

from __future__ import annotations

import sys
from collections.abc import Awaitable
from typing import TypeVar

if sys.version_info >= (3, 11):
    from asyncio import timeout
else:
    from async_timeout import timeout

T = TypeVar("T")


async def within(awaitable: Awaitable[T], timeout_s: float | None) -> T:
    """The result of what is awaited. Raises asyncio.TimeoutError when there is none after ``timeout_s``, in seconds.

    Before Python 3.12 ``asyncio.wait_for`` swallows a cancellation that comes when what it waits for has just ended
    (python/cpython#86296): whoever was to be stopped goes on for ever.
    """
    async with timeout(timeout_s):
        return await awaitable
