"""`tests.support.waiting`: what a test that waits in vain says."""

from __future__ import annotations

import asyncio

import pytest

from tests.support.waiting import described, until


async def test_what_holds_is_returned_at_once() -> None:
    """A condition that holds costs nothing, and its value is what the test gets; a coroutine function is awaited."""

    async def asked() -> str:
        await asyncio.sleep(0)
        return "an answer"

    assert await until(lambda: [7], 0) == [7]
    assert await until(asked, 0) == "an answer"


async def test_what_does_not_come_says_what_was_seen() -> None:
    """The failure tells the condition as it is written, and what its parts were at the end."""
    got = [1, 2]
    with pytest.raises(AssertionError, match=r"not within 0 s: len\(got\) == 3; got is \[1, 2\]$"):
        await until(lambda: len(got) == 3, 0)
    with pytest.raises(AssertionError, match=r"not within 0\.01 s: got\[0\] == 2 and .*; got\[0\] is 1;"):
        await until(
            lambda: got[0] == 2 and not any(number > 5 for number in got),
            0.01,
        )


def test_what_cannot_be_shown_is_named() -> None:
    """A function is told by its name and what it returned."""

    def nobody() -> list[int]:
        return []

    assert described(nobody, []).endswith("nobody is []")
