"""What a headset has asked and nobody has answered yet: its gateway, or robots."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from macs_zenoh.errors import CallTimeout, Refused, Unreachable
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.timeouts import within

from .nodes import REQUEST_IDS, Incoming, fail_all

ROUTER = 0
"""No robot has this id."""


class Questions:
    """Each has a number, which its answer repeats."""

    def __init__(self) -> None:
        self._next = 0
        self._open: dict[tuple[int, int], asyncio.Future[bytes]] = {}
        """By whom was asked, and number."""

    async def ask(self, whom: int, send: Callable[[int], Awaitable[None]], *, timeout_s: float, target: str) -> bytes:
        """The answer of a robot, or of the `ROUTER`, to what ``send(number)`` sends. Raises CallTimeout, naming
        ``target``, and what ``send`` raises."""
        number = self._next
        self._next = (number + 1) % REQUEST_IDS
        answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._open[whom, number] = answer
        try:
            await send(number)
            return await within(answer, timeout_s)
        except asyncio.TimeoutError as error:
            raise CallTimeout(target, timeout_s) from error
        finally:
            del self._open[whom, number]

    def take(self, message: Incoming) -> bool:
        """Whether a message answers an open question."""
        if message.sender_type is None:
            whom = ROUTER
        elif message.sender_type == ROS and message.sender_id:
            whom = message.sender_id
        else:
            return False
        answer = self._open.get((whom, message.metadata.request_id))
        if answer is None or answer.done():
            return False
        answer.set_result(message.data)
        return True

    def waits(self, whom: int, number: int) -> bool:
        """Whether somebody waits for the answer to this question."""
        answer = self._open.get((whom, number))
        return answer is not None and not answer.done()

    def refuse(self, number: int, reason: str) -> None:
        """The gateway did not let the question of this number pass."""
        fail_all([answer for (_, asked), answer in self._open.items() if asked == number], Refused(reason))

    def fail(self, error: Unreachable) -> None:
        """Nobody is going to answer."""
        fail_all(self._open.values(), error)
