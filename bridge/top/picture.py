"""A mesh as it is now: robots, headsets, gateways, routers, topics with their rates. Pure; the time is passed in."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from msgspec import UNSET

from macs_zenoh.protocol.directory import AgentInfo, Change
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.ping import GatewayAgent, GatewayTold, Pong
from macs_zenoh.protocol.robot_state import CarriedStatus, NodeStatus, RobotStatus, added, counting_anew
from macs_zenoh.protocol.routers import Router, Trips, between

from .events import Event, of_gateway, of_presence, of_program, of_robot

MOST_TOPICS = 2000
"""Rows of topics that are kept: what others choose must not decide how much is."""
MOST_LEFT = 64
"""Robots that are gone and of which the last state is kept."""
SILENT_AFTER = 3
"""So many questions without an answer until a robot counts as silent."""


@dataclass
class TopicRow:
    """A topic of a robot that somebody has registered, with its rate since the last look."""

    robot: int
    name: str
    type: str
    role: str
    registrants: list[str]
    messages: int = 0
    bytes: int = 0
    age_s: float | None = None
    rate_hz: float | None = None
    rate_bytes: float | None = None
    holder: str | None = None


@dataclass
class RobotRow:
    """A robot with what it told last."""

    info: AgentInfo
    status: RobotStatus | None = None
    told_s: float = 0.0
    """When, by the monotonic clock."""
    round_trip_s: float | None = None
    unanswered: int = 0
    problem: str = ""
    lost_per_s: float = 0.0
    lost: dict[str, float] = field(default_factory=dict)
    """By counter, how many a second since the last look."""


@dataclass(frozen=True)
class LostRow:
    """What a robot has lost or refused, by the name of its counter (docs/counters.md)."""

    robot: int
    counter: str
    count: int
    per_s: float


@dataclass(frozen=True)
class HeadsetRow:
    """An agent that is no robot, as far as its gateway tells of it."""

    info: AgentInfo
    address: str = ""
    token: str = ""
    age_s: float | None = None
    away: bool = False


@dataclass
class ProgramRow:
    """A gateway or a router."""

    kind: str
    zid: str
    address: str = ""
    versions: str = ""
    round_trip_s: float | None = None
    answers: bool = True
    lost: int = 0
    links: dict[str, float | None] = field(default_factory=dict)
    """Of a router: those that it is linked with, and the link's round trip in seconds where it is known."""
    behind: frozenset[str] = frozenset()
    """Of a router: the sessions that it has."""
    counters: dict[str, int] | None = None
    """Of a gateway: what was lost and refused there, by name."""


class Picture:
    """What is known of a mesh. What it is told returns the events that follow from it."""

    def __init__(self) -> None:
        self.robots: dict[int, RobotRow] = {}
        self.others: dict[tuple[int, int], AgentInfo] = {}
        self.programs: dict[str, ProgramRow] = {}
        """Gateways and routers by their session's id."""
        self.topics: dict[tuple[int, str, str], TopicRow] = {}
        """By robot, role and name."""
        self.away: set[tuple[int, int]] = set()
        self._left: dict[int, RobotRow] = {}
        """Robots that are gone, who went last at the end: when one is back it can be said what happened meanwhile."""
        self._fresh: set[str] = set()
        """Sessions of gateways that have not answered yet, and were not asked before."""
        self.known: dict[tuple[int, int], GatewayAgent] = {}
        """Agents of gateways that tell of them."""

    # -- what is told --------------------------------------------------------------------------------------------

    def presence(self, change: Change, at_s: float) -> list[Event]:
        """Somebody came, changed or left."""
        agent, online, _ = change
        before = self.robots[agent.id].info if agent.type == ROS and agent.id in self.robots else None
        if agent.type != ROS:
            before = self.others.get(agent.key)
        events = list(of_presence(before, agent if online else None, at_s))
        if agent.type != ROS:
            if online:
                self.others[agent.key] = agent
            else:
                self.others.pop(agent.key, None)
                self.known.pop(agent.key, None)
        elif online:
            row = self.robots.get(agent.id) or self._left.pop(agent.id, None) or RobotRow(agent)
            if row.info.session != agent.session and row.status is not None:
                row.status = counting_anew(row.status)  # whatever it tells has happened since
            row.info = agent
            self.robots[agent.id] = row
        else:
            self._leave(agent.id)
            for key in [key for key in self.topics if key[0] == agent.id]:
                del self.topics[key]
        return events

    def told(self, robot: int, status: RobotStatus, round_trip_s: float, now: float, at_s: float) -> list[Event]:
        """A robot has told its state."""
        row = self.robots.get(robot)
        if row is None:
            return []
        before, since_s = row.status, now - row.told_s
        events = list(of_robot(robot, before, status, at_s)) if before is not None else []
        if row.unanswered >= SILENT_AFTER:
            events.append(Event(at_s, "came", str(row.info.key), f"{row.info.key} answers again"))
        if before is not None and since_s > 0:
            more = {name: added(before.drops.get(name, 0), count) for name, count in status.drops.items()}
            row.lost = {name: count / since_s for name, count in more.items()}
            row.lost_per_s = sum(row.lost.values())
        row.status, row.told_s, row.round_trip_s, row.unanswered, row.problem = status, now, round_trip_s, 0, ""
        self._topics_of(robot, status, before is not None, since_s)
        return events

    def silent(self, robot: int, problem: str, at_s: float) -> list[Event]:
        """A robot did not answer."""
        row = self.robots.get(robot)
        if row is None:
            return []
        row.unanswered += 1
        row.problem = problem
        if row.unanswered == SILENT_AFTER:
            return [Event(at_s, "silent", str(row.info.key), f"{row.info.key} does not answer: {problem}")]
        return []

    def gateways(self, pongs: Mapping[str, tuple[Pong, float] | None], at_s: float) -> list[Event]:
        """What gateways said, by session, with the time that it took; None: nothing."""
        rows = {}
        self.away = {agent for told in pongs.values() if told is not None for agent in told[0].away}
        fresh, self._fresh = self._fresh, set()
        for zid, told in pongs.items():
            if told is None and zid not in self.programs and zid not in fresh:
                self._fresh.add(zid)  # it has just come: a moment later it has an address
                continue
            row = self.programs.get(zid) or ProgramRow("gateway", zid)
            row.answers = told is not None
            if told is not None:
                pong, row.round_trip_s = told
                row.address = pong.address
                row.lost = sum(pong.drops.values()) + sum((row.counters or {}).values())
                row.versions = f"macs {pong.macs}, Zenoh {pong.zenoh}"
            rows[zid] = row
        return self._programs("gateway", rows, at_s)

    def told_by_gateway(self, zid: str, told: GatewayTold, at_s: float) -> list[Event]:
        """What a gateway tells of its agents, and of what was lost and refused there."""
        for agent in told.agents:
            self.known[agent.type, agent.id] = agent
        row = self.programs.get(zid)
        if row is None:
            return []
        before, row.counters = row.counters, told.lost
        return [] if before is None else list(of_gateway(row.address or zid[:8], before, told.lost, at_s))

    def routers(self, found: Iterable[Router], own: Collection[str], trips: Trips, at_s: float) -> list[Event]:
        """Routers as they tell of themselves; ``own`` are those that we are linked with."""
        routers = {router.zid: router for router in found}
        linked = between({zid: router.linked for zid, router in routers.items()}, own, trips)
        rows = {}
        for zid, router in routers.items():
            links = {other: linked.get((zid, other)) for other in router.linked}
            release = f"Zenoh {router.release}" if router.release else ""
            address = ", ".join(router.locators)
            rows[zid] = ProgramRow("router", zid, address, release, trips.of(zid), links=links, behind=router.behind)
        return self._programs("router", rows, at_s)

    def link_of(self, zid: str, round_trip_s: float | None) -> tuple[str, float | None] | None:
        """The router that a session is behind, and the round trip of the link to it; None: nobody tells."""
        for row in self.programs.values():
            if zid in row.behind:
                if round_trip_s is None or row.round_trip_s is None or round_trip_s < row.round_trip_s:
                    return row.zid, None  # the last: both are too uncertain
                return row.zid, round_trip_s - row.round_trip_s
        return None

    def _programs(self, kind: str, rows: Mapping[str, ProgramRow], at_s: float) -> list[Event]:
        before = {zid for zid, row in self.programs.items() if row.kind == kind}
        events = [of_program(kind, rows[zid].address or zid[:8], True, at_s) for zid in rows.keys() - before]
        for zid in before - rows.keys():
            row = self.programs.pop(zid)
            events.append(of_program(kind, row.address or zid[:8], False, at_s))
        self.programs.update(rows)
        return events

    def _leave(self, robot: int) -> None:
        row = self.robots.pop(robot, None)
        if row is not None and row.status is not None:
            row.unanswered, row.problem = 0, ""
            self._left[robot] = row
            if len(self._left) > MOST_LEFT:
                del self._left[next(iter(self._left))]

    def _topics_of(self, robot: int, status: RobotStatus, told_before: bool, since_s: float) -> None:
        seen = set()
        for node in status.nodes:
            if node.carried is UNSET:
                continue
            key = (robot, node.role, node.name)
            seen.add(key)
            row = self.topics.get(key)
            if row is None and len(self.topics) >= MOST_TOPICS:
                continue
            self.topics[key] = _topic(robot, node, node.carried, row if told_before else None, since_s)
        for key in [key for key in self.topics if key[0] == robot and key not in seen]:
            del self.topics[key]

    # -- what is so ----------------------------------------------------------------------------------------------

    def losses(self) -> Iterator[LostRow]:
        """What robots have lost, by name."""
        for number, row in sorted(self.robots.items()):
            for name, count in sorted(row.status.drops.items()) if row.status is not None else ():
                yield LostRow(number, name, count, row.lost.get(name, 0.0))

    def headsets(self) -> Iterator[HeadsetRow]:
        """Agents that are no robots, by type and id."""
        for key in sorted(self.others):
            told = self.known.get(key)
            if told is None:
                yield HeadsetRow(self.others[key])
            else:
                yield HeadsetRow(self.others[key], told.address, told.token, told.age_s, key in self.away)

    def state_of(self, robot: RobotRow) -> str:
        """What somebody has to know before commanding it."""
        if robot.unanswered >= SILENT_AFTER:
            return "does not answer"
        status = robot.status
        if status is None:
            return "" if not robot.problem else "?"
        stopped = [f"STOPPED by {status.stop.by}"] if status.stopped else []
        held = [
            f"{node.name}: {node.control.holder}"
            for node in status.nodes
            if node.control is not UNSET and node.control.holder
        ]
        return ", ".join(stopped + held)


def _topic(robot: int, node: NodeStatus, now: CarriedStatus, before: TopicRow | None, since_s: float) -> TopicRow:
    row = TopicRow(robot, node.name, node.type, node.role, node.registrants, now.messages, now.bytes, now.age_s)
    if before is not None and since_s > 0 and now.messages >= before.messages:
        row.rate_hz = (now.messages - before.messages) / since_s
        row.rate_bytes = (now.bytes - before.bytes) / since_s
    if node.control is not UNSET:
        row.holder = node.control.holder
    return row
