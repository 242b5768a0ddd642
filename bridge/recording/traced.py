"""The way of one in so many messages, hop by hop, as those tell who mark and note them. Asyncio."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Collection, Mapping
from typing import Any

from bridge.graph.programs import Programs
from bridge.recording.conditions import Event
from bridge.recording.follower import RobotFollower
from bridge.recording.streams import TRACES
from macs_zenoh.agent import Agent
from macs_zenoh.protocol import trace
from macs_zenoh.protocol.agent_id import AgentId
from macs_zenoh.protocol.keyexpr import STREAM, UNICAST
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.trace import ROUTER, Offset, Point, Report, TraceRequest

POLL_S = 1.0
HOLDS_S = 5.0
"""So long each request holds; it is repeated while the recording goes on."""
GATEWAYS_S = 10.0
CLOCK_S = 30.0
"""So long a comparison of clocks counts: they drift."""
ANSWER_S = 2.0
PROGRAMS = 64
"""So many robots and gateways are asked."""
ALL = 1 << 62
"""Behind all reports: who is only to mark tells none."""

_TOPICS = STREAM.every(type=ROS).removesuffix("**")
_COMMANDS = UNICAST.every(type=ROS).removesuffix("**")
"""How keys begin of what robots put, and of what is sent to them. No session puts others' topics."""


class Traces:
    """Has one in ``every`` messages of each robot in ``robots`` marked, and with ``commands`` of what is sent to it;
    ``put`` takes each as it was noted, on topics that ``wants``. ``note`` hears where nobody tells anything."""

    def __init__(
        self,
        agent: Agent,
        every: int,
        robots: Mapping[int, RobotFollower],
        *,
        commands: bool,
        wants: Callable[[str], bool],
        put: Callable[[Event], None],
        note: Callable[[dict[str, Any]], None],
    ) -> None:
        self._agent = agent
        self._every = every
        self._robots = robots
        self._commands = commands
        self._wants = wants
        self._put = put
        self._note = note
        self._programs = Programs(agent.mesh, ANSWER_S)
        self._gateways: list[str] = []
        self._gateways_at = -GATEWAYS_S
        self._after: dict[str, int] = {}
        """By session: up to which report it has told."""
        self._clocks: dict[str, tuple[float, Offset]] = {}
        self._silent: set[str] = set()
        self._task = asyncio.get_running_loop().create_task(self._go_on())

    def close(self) -> None:
        """Ask no more; what was asked for ends by itself."""
        self._task.cancel()

    async def _go_on(self) -> None:
        while True:
            await self._look()
            await asyncio.sleep(POLL_S)

    async def _look(self) -> None:
        if time.monotonic() > self._gateways_at + GATEWAYS_S:
            self._gateways = await self._programs.gateways()
            self._gateways_at = time.monotonic()
        robots = [(found.zid, robot) for robot in self._robots if (found := self._agent.directory.get(ROS, robot))]
        for zid, robot in robots:
            if zid not in self._gateways:  # whose robots have no session of their own
                self._programs.names[zid] = f"robot {robot}"
        putting = {zid for zid, _ in robots}
        asked = [*[*dict.fromkeys([*putting, *self._gateways])][:PROGRAMS], self._agent.mesh.zid]
        if self._commands:
            mark = TraceRequest(
                put=_COMMANDS, every=self._every, look=False, seconds=HOLDS_S, commands=True, after=ALL
            )
            await asyncio.gather(*(self._programs.ask(zid, mark) for zid in self._gateways if zid in asked))
        self._after = {zid: after for zid, after in self._after.items() if zid in asked}
        for zid, reports in await self._told(asked, putting):
            for event in await self._events(zid, reports):
                self._put(event)

    async def _told(self, zids: list[str], putting: Collection[str]) -> list[tuple[str, list[Report]]]:
        """What each has noted since it was asked last; at first nothing, since it may be old."""

        def request(zid: str) -> TraceRequest:
            put = _TOPICS if zid in putting else ""
            return TraceRequest(put=put, every=self._every, seconds=HOLDS_S, after=self._after.get(zid, 0))

        answers = await asyncio.gather(*(self._programs.ask(zid, request(zid)) for zid in zids))
        found = []
        for zid, answer in zip(zids, answers, strict=True):
            if answer is None:
                self._is_silent(zid)
                continue
            reports = answer.reports[: trace.MOST_REPORTS]
            if zid in self._after:
                found.append((zid, reports))
            self._after[zid] = max([self._after.get(zid, 0), *(report.number for report in reports)])
        return found

    def _is_silent(self, zid: str) -> None:
        name = self._name(zid)
        if name not in self._silent and len(self._silent) < PROGRAMS:
            self._silent.add(name)
            self._note({"not_traced": name, "why": "it does not answer; access rules may forbid to ask it"})

    async def _events(self, zid: str, reports: list[Report]) -> list[Event]:
        told = [(report, about) for report in reports if (about := self._about(report)) is not None]
        ways = [[Point(*point) for point in report.points[: trace.MOST_POINTS]] for report, _ in told]
        programs = {point.clock for way in ways for point in way if point.name != ROUTER}
        clocks = {clock: await self._clock(clock) for clock in programs}
        ways = [trace.corrected(way, clocks) for way in ways]
        for clock in {point.clock for way in ways for point in way if point.name == ROUTER}:
            clocks[clock] = trace.bound_by_order(ways, clock)
            ways = [trace.corrected(way, {clock: clocks[clock]}) for way in ways]
        return [
            Event(
                TRACES, {**about, "to": self._name(zid), "at_once": report.way == "at once", **self._way(way, clocks)}
            )
            for (report, about), way in zip(told, ways, strict=True)
        ]

    def _way(self, way: list[Point], clocks: Mapping[str, Offset]) -> dict[str, Any]:
        known: dict[str, float | None] = {}
        for point in way:
            within_ns = clocks[point.clock].within_ns
            name = self._name(point.clock, "router " if point.name == ROUTER else "")
            known[name] = None if within_ns is None else round(within_ns / 1e6, 4)
        hops = [{"hop": hop.name, "ms": _ms(hop.took_ns)} for hop in trace.hops(way, self._programs.names)]
        took_ms = _ms(way[-1].at_ns - way[0].at_ns)
        return {"ms": took_ms, "hops": hops, "began_ns": way[0].at_ns, "clocks_within_ms": known}

    def _name(self, zid: str, unnamed: str = "") -> str:
        return self._programs.names.get(zid) or f"{unnamed}{zid[:8]}"

    def _about(self, report: Report) -> dict[str, Any] | None:
        """Which message it was; None for what is not recorded."""
        if not report.points:
            return None
        stream = STREAM.parse(report.key)
        if stream is not None and stream.type == ROS and (follower := self._robots.get(stream.id)) is not None:
            topic = follower.topic_of(stream.node)
            return {"robot": stream.id, "topic": topic} if self._wants(topic) else None
        sent = UNICAST.parse(report.key) if self._commands else None
        if sent is None or sent.type != ROS or sent.id not in self._robots:
            return None
        return {"robot": sent.id, "commands_of": str(AgentId(*sent.sender))}

    async def _clock(self, zid: str) -> Offset:
        """Of sessions that are online alone: who is asked may name others without end."""
        at, offset = self._clocks.get(zid, (-CLOCK_S, Offset()))
        if time.monotonic() < at + CLOCK_S:
            return offset
        if zid not in self._after and all(agent.zid != zid for agent in self._agent.online()):
            return Offset()
        offset = await self._programs.clock(zid)
        if len(self._clocks) > 2 * PROGRAMS:
            self._clocks.clear()
        self._clocks[zid] = time.monotonic(), offset
        return offset


def _ms(time_ns: float) -> float:
    return round(time_ns / 1e6, 4)
