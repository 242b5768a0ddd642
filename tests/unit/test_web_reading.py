"""What a gateway does between two WebSocket messages: nothing while the next one is there already."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest

from bridge.gateway.websocket import AtOnce


async def awaited(coroutine: Any) -> tuple[Any, int]:
    """What it gives, and how often something else was done first."""
    others = [0]

    def other() -> None:
        others[0] += 1

    try:
        return await cast(Any, AtOnce(coroutine, other)), others[0]
    except ValueError as error:
        return error, others[0]


async def test_what_is_there_is_taken_at_once() -> None:
    """With no message to wait for nothing else is done."""

    async def there() -> str:
        return "message"

    assert await awaited(there()) == ("message", 0)


async def test_something_else_is_done_before_a_wait() -> None:
    """Before each wait, and what is waited for is given as ever, an error too."""

    async def later(fails: bool) -> str:
        await asyncio.sleep(0)
        await asyncio.sleep(0.001)
        if fails:
            raise ValueError
        return "message"

    assert await awaited(later(fails=False)) == ("message", 2)
    error, others = await awaited(later(fails=True))
    assert (type(error), others) == (ValueError, 2)


async def test_an_error_of_what_is_waited_for_reaches_who_waits() -> None:
    """aiohttp ends its waiting by an error in a future, and makes a message of it."""
    future = asyncio.get_running_loop().create_future()

    async def survives() -> str:
        try:
            await future
        except OSError:
            await asyncio.sleep(0)
            return "ended"
        return "never"

    asyncio.get_running_loop().call_soon(future.set_exception, OSError())
    assert await awaited(survives()) == ("ended", 2)


async def test_who_waits_can_be_cancelled() -> None:
    """The task ends, and so does what it waited for."""
    ended = []

    async def waits() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ended.append(True)

    task = asyncio.ensure_future(awaited(waits()))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert ended == [True]
