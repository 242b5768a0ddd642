"""The clock by which a headset tells when it made its commands (`macs_zenoh.protocol.command_clock`)."""

from __future__ import annotations

import asyncio
import math
import secrets
import time
from collections.abc import Awaitable, Callable, Collection
from contextlib import suppress

from macs_zenoh.errors import Unreachable
from macs_zenoh.protocol.command_clock import TICK_S
from macs_zenoh.protocol.messages import CommandClock, decode_data, encode_data

HELLO_S = 1.0
"""Between two hellos to robots that do not know the clock."""
HELLO_AGAIN_S = 20.0
"""And to those that do, while they are commanded: otherwise they ask no more some time."""
TOGETHER = 10
"""So many robots and groups a message can be for."""
REFUSED_BY = 64
"""Of robots that refuse commands, so many are told at one time."""
LAST = 900_000_000
"""At this time another clock begins: gateways judge numbers of nine digits fastest."""

Say = Callable[[bytes, Collection[int], Collection[int]], Awaitable[None]]
"""Sends data of `CommandClock` to robots and groups of robots."""


class OwnClock:
    """Its time rises with each command, and begins at 1. ``now`` is in seconds, monotonic."""

    def __init__(self, say: Say, now: Callable[[], float] = time.monotonic) -> None:
        self._say = say
        self._now = now
        self._last = 0
        self.robots: set[int] = set()
        """Robots that are told the time."""
        self.groups: set[int] = set()
        self.known: dict[int, float] = {}
        """Robots that take commands by it, and how old these may be, in s; 0: of any age."""
        self._asked: set[int] = set()
        """Robots that have asked for it: they want the time of each command."""
        self._refused_by: set[int] = set()
        """Robots that have refused commands by it, which may be told nothing but in a group."""
        self._is_due = False
        self._changed = asyncio.Event()
        self._said_at = -math.inf
        self._begin()

    @property
    def ticks(self) -> int:
        """The time now."""
        return int((self._now() - self._began) / TICK_S) + 1

    def tells(self, robots: Collection[int], groups: Collection[int]) -> bool:
        """Whether a command to these carries the time. To groups it does as soon as anybody is told: of their members
        the one refuses what carries none, and others do not mind."""
        if groups and (self.robots or self.groups):
            return True
        return not (self.robots.isdisjoint(robots) and self._asked.isdisjoint(robots))

    def stamp(self, ticks: int = 0) -> int:
        """The time of a command that is made now, or was at ``ticks``; later than those before in any case."""
        self._last = max(self._last + 1, ticks or self.ticks)
        return self._last

    async def hello(self) -> None:
        """Say it to all who are told the time, and who have refused commands by it."""
        if self.ticks > LAST:
            self._begin()
        self._said_at = self._now()
        robots, groups = sorted(self.robots | self._refused_by), sorted(self.groups)
        data = encode_data(CommandClock(clock=self.name))
        for first in range(0, max(len(robots), len(groups)), TOGETHER):
            await self._say(data, robots[first : first + TOGETHER], groups[first : first + TOGETHER])
        self._is_due = False
        self._refused_by.clear()

    async def take(self, robot: int, data: bytes) -> None:
        """What a robot says of it. Raises what decoding raises."""
        said = decode_data(CommandClock, data)
        if said.clock != self.name:
            return
        self._asked.add(robot)
        if said.known:
            self.known[robot] = said.max_age_s or 0.0
            self._changed.set()
        elif robot in self.known:
            del self.known[robot]
        if said.question:
            answer = CommandClock(clock=self.name, question=said.question, at=self.ticks)
            await self._say(encode_data(answer), (robot,), ())

    def unknown(self, robot: int | None = None) -> None:
        """A robot does not know it, or none does any more: it is said again soon."""
        self._is_due = True
        if robot is None:
            self.known.clear()
            return
        self.known.pop(robot, None)
        if len(self._refused_by) < REFUSED_BY:
            self._refused_by.add(robot)

    async def wait_known(self, robots: Collection[int], timeout_s: float) -> set[int]:
        """Say hello until all of these know it, or for so long: those that do."""
        deadline = self._now() + timeout_s
        wanted = set(robots)
        while not wanted <= self.known.keys() and (left_s := deadline - self._now()) > 0:
            if self._now() - self._said_at >= HELLO_S:
                await self.hello()
            self._changed.clear()
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._changed.wait(), min(left_s, HELLO_S / 4))
        return wanted & self.known.keys()

    async def keep_known(self) -> None:
        """Say hello as often as is needed, until cancelled."""
        while True:
            await asyncio.sleep(HELLO_S)
            due_s = HELLO_S if self._is_due or self.robots - self.known.keys() else HELLO_AGAIN_S
            if self._now() - self._said_at >= due_s or self.ticks > LAST:
                with suppress(Unreachable):
                    await self.hello()

    def _begin(self) -> None:
        self.name = secrets.token_hex(8)
        self._began = self._now()
        self._last = 0
        self.known.clear()
