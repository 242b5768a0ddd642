"""Limits of time: a result, none in time, and a cancellation that comes just then."""

from __future__ import annotations

import asyncio

import pytest

from macs_zenoh.timeouts import within


async def test_a_result_in_time() -> None:
    """What is awaited comes back, and so does its error."""
    assert await within(asyncio.sleep(0, "done"), 5) == "done"
    assert await within(asyncio.sleep(0, "done"), None) == "done"
    failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    failed.set_exception(KeyError("x"))
    with pytest.raises(KeyError):
        await within(failed, 5)


async def test_no_result_in_time() -> None:
    """What takes too long is cancelled."""
    never: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    with pytest.raises(asyncio.TimeoutError):
        await within(never, 0.01)
    assert never.cancelled()


@pytest.mark.parametrize("first", ["result", "cancellation"])
async def test_no_cancellation_is_swallowed(first: str) -> None:
    """Who is cancelled in the moment in which the result comes is cancelled."""
    went_on = False

    async def work(result: asyncio.Future[None]) -> None:
        nonlocal went_on
        await within(result, 5)
        went_on = True
        await asyncio.sleep(0)
        await within(asyncio.Event().wait(), 60)

    result: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(work(result))
    for _ in range(3):
        await asyncio.sleep(0)
    steps = [lambda: result.set_result(None), task.cancel]
    for step in steps if first == "result" else reversed(steps):
        if not result.done():
            step()
        else:
            task.cancel()
    done, _ = await asyncio.wait([task], timeout=1)
    assert done
    assert task.cancelled()
    assert not went_on
