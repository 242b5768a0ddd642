"""Traces for pages: the hops of a topic's messages to this gateway, and of commands from here to a robot. They are
collected once for all who look, and only then."""

from __future__ import annotations

import asyncio
import math
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, cast

from bridge.graph.programs import Programs
from bridge.graph.site import Site
from bridge.graph.traces import Noting, Tracing
from macs_zenoh.errors import MacsError, NotServed, Refused, Unreachable
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol import ping, trace
from macs_zenoh.protocol.directory import Directory
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.trace import TraceAnswer, TraceRequest

from .fresh import Fresh

COLLECT_S = 1.0
COUNT = 100
"""So many messages are enough for one look."""
GOOD_S = 0.3
ANSWER_S = 1.0
FORGOTTEN_S = 5.0
"""Where nobody has looked for so long, what came meanwhile is old."""
MAYBE = "it is older, or access rules keep the verb trace from this gateway (macs security generate)"
TOPICS = 16
"""So many topics are traced at one time; whose messages are awaited is not forgotten for another."""


class _Seen(NamedTuple):
    """The last report that was looked at, by whom it was told, and when."""

    by: str = ""
    number: int = 0
    at_s: float = -math.inf


@dataclass
class _Session:
    mesh: Mesh
    directory: Directory


@dataclass
class _Here:
    """Of a site what tracing asks."""

    agent: _Session
    timeout_s: float = ANSWER_S


Ask = Callable[[int, str, bytes], Awaitable[bytes]]


class _ByVerb(Programs):
    """Asks a robot by the verb ``trace``, which goes with seeing it; a ping is for operators where there are access
    rules. One that does not know the verb is pinged."""

    def __init__(self, mesh: Mesh, robot: int, zid: str, ask: Ask) -> None:
        super().__init__(mesh, ANSWER_S)
        self._robot = robot
        self._zid = zid
        self._ask = ask
        self._knows = True
        self.problem = ""
        """Why the robot told nothing the last time that it was asked."""

    async def ask(self, zid: str, request: TraceRequest) -> TraceAnswer | None:
        if zid != self._zid:
            return await super().ask(zid, request)
        told = await self._told(trace.encode_request(request)) if self._knows else None
        if self._knows:
            return told[1] if told is not None else None
        answer = await super().ask(zid, request)
        if answer is not None:
            self.problem = ""
        return answer

    async def pong(self, zid: str) -> ping.Pong | None:
        told = await self._told(b"") if zid == self._zid and self._knows else None
        return told[0] if told is not None else await super().pong(zid)

    async def _told(self, asked: bytes) -> tuple[ping.Pong, TraceAnswer] | None:
        try:
            said, told = ping.decode(await self._ask(self._robot, "trace", asked))
            answer = trace.decode_answer(told) if asked else TraceAnswer()
        except MacsError as error:
            self._knows = not isinstance(error, NotServed)
            self.problem = str(error)
            return None
        self.problem = ""
        return said, answer


class _Look(Tracing):
    """One look of several: it tells what has come since the last one, if that was just now. What is traced goes on
    anyway: a topic that somebody at this gateway receives, commands that are sent here."""

    async def begin_after(self, seen: _Seen) -> None:
        """Go on behind what was ``seen``."""
        own = self._mesh.zid
        self._names[own] = "this gateway"
        self._marking = [own if self._commands else self._robot_zid]
        noting = Noting(self._robot_zid if self._commands else own, "")
        noting.name = self._names[noting.zid]
        self._looking = [noting]
        if time.monotonic() - seen.at_s < FORGOTTEN_S and seen.by == noting.zid:
            noting.after = seen.number
        else:
            await self.skip()

    def seen(self) -> _Seen:
        """Up to where it has looked."""
        (noting,) = self._looking
        return _Seen(noting.zid, noting.after, time.monotonic())


class Traces:
    """Of one gateway. ``ask`` asks a robot's verb."""

    def __init__(self, mesh: Mesh, directory: Directory, ask: Ask) -> None:
        self._here = _Here(_Session(mesh, directory))
        self._ask = ask
        self._kept: OrderedDict[tuple[int, str], Fresh[list[dict[str, Any]]]] = OrderedDict()
        """By robot and topic; commands are those of no topic."""
        self._seen: dict[tuple[int, str], _Seen] = {}
        self._one = asyncio.Lock()
        """What a program notes is told once: two that collect would each have a part."""

    async def of(self, robot: int, topic: str) -> list[dict[str, Any]]:
        """Each way that messages took since the last look, as `bridge.graph.traces.Traced` tells it; none where no
        message came. Without a topic it is commands that are sent through this gateway. Raises Refused, Unreachable,
        UsageError."""
        fresh = self._kept.get((robot, topic))
        if fresh is None:
            if len(self._kept) >= TOPICS:
                idle = next((about for about, kept in self._kept.items() if not kept.asking), None)
                if idle is None:
                    raise Refused(f"{TOPICS} topics are traced for pages already")
                del self._kept[idle]
                self._seen.pop(idle, None)
            fresh = self._kept[robot, topic] = Fresh(partial(self._collect, robot, topic), GOOD_S)
        self._kept.move_to_end((robot, topic))
        return await fresh.now()

    def close(self) -> None:
        """Collect no more."""
        for fresh in self._kept.values():
            fresh.close()

    async def _collect(self, robot: int, topic: str) -> list[dict[str, Any]]:
        async with self._one:
            programs = self._programs_of(robot)
            tracing = _Look(
                cast(Site, self._here), robot, topic or "/", every=1, commands=not topic, programs=programs
            )
            await tracing.begin_after(self._seen.get((robot, topic), _Seen()))
            await tracing.collect(seconds=COLLECT_S, count=COUNT)
            found = await tracing.conclude()
            self._seen[robot, topic] = tracing.seen()
            if programs.problem and not found:
                raise Unreachable(f"robot {robot}", f"it tells no traces ({programs.problem}): {MAYBE}")
        return [traced.facts() for traced in sorted(found, key=lambda each: -each.count)]

    def _programs_of(self, robot: int) -> _ByVerb:
        agent = self._here.agent
        found = agent.directory.get(ROS, robot)
        return _ByVerb(agent.mesh, robot, found.zid if found is not None else "", self._ask)
