"""A robot or a headset in a process of its own on another host, asked from a test line by line (JSON on its pipes).

::

    async with Inside("robot", connect=["tcp/10.213.0.1:7447"], within=host.within) as robot:
        await robot.ask("stream", topic="/camera", hz=30, size=120_000)
        got = await robot.ask("received", topic="/cmd_vel")

The processes are those of `tests.network.ends`. All hosts share one clock (CLOCK_MONOTONIC), so a message that carries
the time when it was sent tells on arrival how long it took.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from tests.support.workers import Worker


class Received(NamedTuple):
    """One message as it arrived."""

    number: int
    """Counted by the sender, from 0."""
    sent_s: float
    """When it was sent, CLOCK_MONOTONIC."""
    took_s: float
    size: int
    sender: int


class Inside(Worker):
    """A process of `tests.network.ends`."""

    def __init__(self, end: str, *, within: Sequence[str] = (), **options: Any) -> None:
        super().__init__("tests.network.ends", end, json.dumps(options), within=within)

    async def received(self, topic: str) -> list[Received]:
        """What came on a topic since it was asked for the last time."""
        return [Received(*row) for row in await self.ask("received", topic=topic)]

    async def until_online(self, kind: str, number: int, timeout_s: float = 10.0) -> None:
        """Wait until this end sees an agent online."""
        await self._until("online", lambda agents: [kind, number] in agents, timeout_s)

    async def until_gone(self, kind: str, number: int, timeout_s: float = 20.0) -> None:
        """Wait until this end sees an agent no more."""
        await self._until("online", lambda agents: [kind, number] not in agents, timeout_s)

    async def until_registered(self, topic: str, timeout_s: float = 10.0) -> None:
        """Wait until a headset is registered for this robot's topic."""
        await self._until("registered", bool, timeout_s, topic=topic)

    async def until_received(self, topic: str, timeout_s: float = 10.0) -> list[Received]:
        """Wait until something has come on a topic; what."""
        rows = await self._until("received", bool, timeout_s, topic=topic)
        return [Received(*row) for row in rows]

    async def _until(self, what: str, right: Callable[[Any], bool], timeout_s: float, **arguments: Any) -> Any:
        deadline = time.monotonic() + timeout_s
        while not right(answer := await self.ask(what, **arguments)):
            assert time.monotonic() < deadline, f"{what} {arguments} is still {answer} after {timeout_s} s"
            await asyncio.sleep(0.02)
        return answer


def quantile(values: Sequence[float], share: float) -> float:
    """The value that ``share`` of all do not exceed."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def lost(received: Sequence[Received], first: int, after: int) -> int:
    """How many of the messages from ``first`` up to and not including ``after`` did not come."""
    return after - first - len({message.number for message in received if first <= message.number < after})


def longest_gap_s(received: Sequence[Received]) -> float:
    """The longest time between two arrivals."""
    arrivals = sorted(message.sent_s + message.took_s for message in received)
    return max((later - earlier for earlier, later in itertools.pairwise(arrivals)), default=0.0)


def median_ms(received: Sequence[Received]) -> float:
    """The median of the times that messages took."""
    return 1000 * statistics.median(message.took_s for message in received)
