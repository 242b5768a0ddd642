"""Traces of a robot's messages: asked for, collected from all who note them, and told hop by hop."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from macs_zenoh.errors import Unreachable
from macs_zenoh.protocol import trace
from macs_zenoh.protocol.keyexpr import STREAM
from macs_zenoh.protocol.messages import ROS, node_name
from macs_zenoh.protocol.offers import absolute
from macs_zenoh.protocol.trace import ROUTER, Hop, Offset, Point, Report, TraceRequest, at_share
from macs_zenoh.topics import TopicSubscription

from .echo import subscribed
from .programs import Programs
from .site import Site

POLL_S = 0.2
HOLDS_S = 3.0
"""So long each request holds; it is repeated while traces are collected."""
MOST_OTHERS = 50
"""Of agents that are behind no gateway so many are asked to mark what they send."""
WARM = 2
"""So many first messages of each way do not count: they find nothing prepared."""


@dataclass
class Noting:
    """A program that notes marked messages, and what it has told so far."""

    zid: str
    name: str
    after: int = 0
    reports: list[Report] = field(default_factory=list)


class Row(NamedTuple):
    """A hop, in ms."""

    hop: str
    mean_ms: float
    p50_ms: float
    p99_ms: float
    min_ms: float
    max_ms: float


@dataclass(frozen=True)
class Traced:
    """All messages of one way; the last row is the whole."""

    title: str
    receiver: str
    topic: str
    robot: int
    count: int
    at_once: int
    rows: list[Row]
    clocks: dict[str, float | None]
    """By name: within how many ms it is known; None: not at all."""

    @property
    def clocks_text(self) -> str:
        return ", ".join(
            f"{name} within {bound:.3f} ms" if bound is not None else f"{name} not known"
            for name, bound in sorted(self.clocks.items())
        )

    def facts(self) -> dict[str, Any]:
        """For programs."""
        return {
            "topic": self.topic,
            "robot": self.robot,
            "receiver": self.receiver,
            "count": self.count,
            "at_once": self.at_once,
            "hops": [row._asdict() for row in self.rows[:-1]],
            "end_to_end": {name: value for name, value in self.rows[-1]._asdict().items() if name != "hop"},
            "clocks_within_ms": self.clocks,
        }


class Tracing:
    """One ``macs trace``."""

    def __init__(
        self, site: Site, robot: int, topic: str, *, every: int, commands: bool, programs: Programs | None = None
    ) -> None:
        """``programs`` asks in another way than by pings."""
        self._site = site
        self._mesh = site.agent.mesh
        self._robot = robot
        self._topic = absolute(topic)
        self._every = every
        self._commands = commands
        found = site.agent.directory.get(ROS, robot)
        if found is None:
            raise Unreachable(f"robot {robot}", "it is not online (macs ls)")
        self._robot_zid = found.zid
        self._programs = programs or Programs(self._mesh, site.timeout_s)
        self._names = self._programs.names
        self._names[found.zid] = f"robot {robot}"
        self._looking: list[Noting] = []
        self._marking: list[str] = []
        """Sessions of those who put what is traced."""
        self._subscription: TopicSubscription | None = None
        self._taking: asyncio.Task[None] | None = None
        self._scope: Any = None

    @property
    def _key(self) -> str:
        """How the keys begin of what is traced."""
        if self._commands:
            return trace.told_to(self._robot)
        return STREAM.of(type=ROS, id=self._robot, node=node_name(self._topic))

    async def begin(self) -> None:
        """Find who marks and who notes, and receive the topic here. Raises Unreachable, Refused, UsageError."""
        gateways = await self._programs.gateways()
        if self._commands:
            others = dict.fromkeys(agent.zid for agent in self._site.agent.online())
            putting = dict.fromkeys([*gateways, *list(others)[:MOST_OTHERS]])
            self._marking = [zid for zid in putting if zid not in (self._mesh.zid, self._robot_zid)]
            self._looking = [Noting(self._robot_zid, self._names[self._robot_zid])]
            await self.skip()
            return
        self._marking = [self._robot_zid]
        self._looking = [Noting(zid, self._names[zid]) for zid in gateways]
        self._looking.append(Noting(self._mesh.zid, "here"))
        await self.skip()
        self._scope = subscribed(self._site, self._topic, None)
        self._subscription = await self._scope.__aenter__()
        self._taking = asyncio.get_running_loop().create_task(self._take(self._subscription))

    async def skip(self) -> None:
        """Leave out what was noted until now: others have asked for it, and it may be old."""
        await self._poll()
        for noting in self._looking:
            noting.reports.clear()

    async def end(self) -> None:
        """Receive the topic no more; what was asked for ends by itself."""
        if self._taking is not None:
            self._taking.cancel()
        if self._scope is not None:
            await self._scope.__aexit__(None, None, None)

    async def _take(self, subscription: TopicSubscription) -> None:
        async for _ in subscription:
            pass

    async def collect(self, *, seconds: float, count: int | None) -> None:
        """Ask again and again, until there were so many messages of one way, or for so long."""
        deadline = time.monotonic() + seconds
        marked_s = 0.0
        while time.monotonic() < deadline:
            if time.monotonic() - marked_s > HOLDS_S / 3:
                marked_s = time.monotonic()
                mark = TraceRequest(
                    put=self._key, every=self._every, look=False, seconds=HOLDS_S, commands=self._commands
                )
                await asyncio.gather(*(self._programs.ask(zid, mark) for zid in self._marking))
            await self._poll()
            if count is not None and any(len(noting.reports) >= count + WARM for noting in self._looking):
                return
            await asyncio.sleep(POLL_S)

    async def _poll(self) -> None:
        answers = await asyncio.gather(
            *(self._programs.ask(each.zid, TraceRequest(seconds=HOLDS_S, after=each.after)) for each in self._looking)
        )
        for noting, answer in zip(self._looking, answers, strict=True):
            for report in answer.reports if answer is not None else ():
                noting.after = max(noting.after, report.number)
                if report.key.startswith(self._key):
                    noting.reports.append(report)

    # -- what follows --------------------------------------------------------------------------------------------

    async def conclude(self) -> list[Traced]:
        """Each way that messages took, by who received them; none of nothing."""
        await self._poll()
        reports = [report for noting in self._looking for report in noting.reports]
        programs = {clock for report in reports for name, _, clock in report.points if name != ROUTER}
        clocks = {zid: await self._programs.clock(zid) for zid in programs}
        return [traced for noting in self._looking for traced in self._ways(noting, clocks)]

    def _ways(self, noting: Noting, clocks: Mapping[str, Offset]) -> Iterator[Traced]:
        """Messages that passed the same points, each such way by itself."""
        by_way: dict[tuple[tuple[str, str], ...], list[tuple[Report, list[Point]]]] = {}
        for report in noting.reports:
            points = trace.corrected([Point(*point) for point in report.points], clocks)
            by_way.setdefault(tuple((point.name, point.clock) for point in points), []).append((report, points))
        for way, reports in by_way.items():
            kept = reports[WARM:] if len(reports) > 2 * WARM else reports
            yield self._traced(noting, way, kept, dict(clocks))

    def _traced(
        self,
        noting: Noting,
        way: tuple[tuple[str, str], ...],
        reports: list[tuple[Report, list[Point]]],
        clocks: dict[str, Offset],
    ) -> Traced:
        ways = [points for _, points in reports]
        for clock in dict.fromkeys(clock for name, clock in way if name == ROUTER):
            clocks[clock] = trace.bound_by_order(ways, clock)
            ways = [trace.corrected(points, {clock: clocks[clock]}) for points in ways]
        taken = [list(trace.hops(points, self._names)) for points in ways]
        rows = [_row(name, [hops[at].took_ns for hops in taken]) for at, name in enumerate(_names(taken[0]))]
        rows.append(_row("end to end", [sum(hop.took_ns for hop in hops) for hops in taken]))
        shown = {}
        for name, clock in way:
            offset = clocks.get(clock, Offset())
            title = self._names.get(clock) or f"{'router ' if name == ROUTER else ''}{clock[:8]}"
            shown[title] = None if offset.within_ns is None else round(offset.within_ns / 1e6, 4)
        what = f"commands to robot {self._robot} from {self._names.get(way[0][1], way[0][1][:8])}"
        title = what if self._commands else f"{self._topic} of robot {self._robot} to {noting.name}"
        at_once = sum(report.way == "at once" for report, _ in reports)
        return Traced(title, noting.name, self._topic, self._robot, len(reports), at_once, rows, shown)


def _names(hops: list[Hop]) -> list[str]:
    return [hop.name for hop in hops]


def _row(name: str, times_ns: list[float]) -> Row:
    ordered = sorted(times_ns)
    mean, p50, p99 = sum(ordered) / len(ordered), at_share(ordered, 0.5), at_share(ordered, 0.99)
    return Row(name, *(round(value / 1e6, 4) for value in (mean, p50, p99, ordered[0], ordered[-1])))
