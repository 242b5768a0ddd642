"""Robots as somebody on the mesh asks for them: those that were named, those that are online, what they offer."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import msgspec

from macs_zenoh import robot_types
from macs_zenoh.agent import Agent
from macs_zenoh.errors import MacsError, Refused, TooLong, Unreachable, UsageError
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.keyexpr import PING
from macs_zenoh.protocol.limits import ANSWER_BYTES
from macs_zenoh.protocol.messages import ROS, NodeType
from macs_zenoh.protocol.offers import absolute, closest, type_behind
from macs_zenoh.protocol.robot_state import Offered, RobotStatus
from macs_zenoh.protocol.schemas import DefinitionsReply

log = logging.getLogger("macs.graph")

Told = TypeVar("Told", Offered, RobotStatus)
_T = TypeVar("_T")

PINGS = 5
"""Of so many comparisons of two clocks the closest one counts."""


@dataclass(frozen=True)
class Chosen:
    """The robots that somebody named, by id and by group; none of both: nobody was named."""

    robots: tuple[int, ...] = ()
    groups: tuple[int, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.robots or self.groups)


@dataclass(frozen=True)
class Clock:
    """How far the clock of a robot is ahead of ours, and how well that is known."""

    ahead_s: float
    within_s: float


class Looking:
    """The robots that somebody sees. ``known`` are those online, ``ask(robot, verb, data)`` asks one; ``timeout_s``
    bounds each answer; ``elsewhere`` follows "none is online"."""

    def __init__(
        self,
        known: Callable[[], Collection[AgentInfo]],
        ask: Callable[[int, str, bytes], Awaitable[bytes]],
        chosen: Chosen,
        timeout_s: float,
        elsewhere: str = "",
    ) -> None:
        self._known = known
        self._elsewhere = elsewhere
        self._call = ask
        self.chosen = chosen
        self.timeout_s = timeout_s

    def online(self) -> list[int]:
        """Ids of the robots that are meant and online; of all that are online, where nobody was named."""
        return [
            robot.id
            for robot in self._known()
            if not self.chosen or robot.id in self.chosen.robots or robot.group in self.chosen.groups
        ]

    def must_be_online(self) -> list[int]:
        """The same. Raises Unreachable when it is none, or one that was named is not there."""
        online = self.online()
        for robot in self.chosen.robots:
            if robot not in online:
                raise Unreachable(f"robot {robot}", f"it is not online{self._elsewhere} (macs ls)")
        if not online:
            named = ", ".join(map(str, self.chosen.groups))
            who = f"a robot of group {named}" if named else "any robot"
            raise Unreachable(who, f"none is online{self._elsewhere} (macs ls)")
        return online

    def only(self) -> list[int]:
        """Those that something is done to. Raises UsageError where nobody was named of several, Unreachable."""
        online = self.must_be_online()
        if not self.chosen and len(online) > 1:
            shown = ", ".join(map(str, online[:10])) + (", ..." if len(online) > 10 else "")
            raise UsageError(f"robots {shown} are online: say which one is meant, with --robot or --group")
        return online

    async def offers(self, robots: Collection[int]) -> dict[int, Offered]:
        """What these robots have; those that do not tell are left out, and logged."""
        return await self._told(robots, "offers", Offered)

    async def must_offer(self, robots: Collection[int]) -> dict[int, Offered]:
        """The same. Raises Unreachable where none of them tells."""
        told = await self.offers(robots)
        if robots and not told:
            why = "nobody tells what it has; access rules may not let you ask (--as, docs/security.md)"
            raise Unreachable(named(robots), why)
        return told

    async def states(self, robots: Collection[int]) -> dict[int, RobotStatus]:
        """How these robots are, likewise."""
        return await self._told(robots, "status", RobotStatus)

    async def definitions(self, types: Mapping[int, str]) -> dict[int, DefinitionsReply]:
        """How each of these robots defines its type, with what that needs, likewise."""

        def asked(robot: int, of_type: str) -> Awaitable[DefinitionsReply]:
            return robot_types.definitions(lambda verb, data: self._call(robot, verb, data), [of_type])

        return await _each(types, [asked(robot, of_type) for robot, of_type in types.items()])

    async def _told(self, robots: Collection[int], verb: str, kind: type[Told]) -> dict[int, Told]:
        return await _each(robots, [self._ask(robot, verb, kind) for robot in robots])

    async def _ask(self, robot: int, verb: str, kind: type[Told]) -> Told:
        answer = await self._call(robot, verb, b"")
        try:
            if len(answer) > ANSWER_BYTES:
                raise TooLong("an answer", len(answer), ANSWER_BYTES)
            return msgspec.json.decode(answer, type=kind)
        except (TooLong, msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise Unreachable(f"robot {robot}", f"its answer makes no sense: {error}") from error


class Site(Looking):
    """The robots that an agent sees, who may do more with them than look."""

    def __init__(self, agent: Agent, chosen: Chosen, timeout_s: float, elsewhere: str = "") -> None:
        super().__init__(
            lambda: agent.directory.of_type(ROS),
            lambda robot, verb, data: agent.call(ROS, robot, verb, data, timeout_s=timeout_s),
            chosen,
            timeout_s,
            elsewhere,
        )
        self.agent = agent

    async def clock(self, robot: int) -> Clock | None:
        """The clock of a robot against ours; None for one that does not answer."""
        found = self.agent.directory.get(ROS, robot)
        best: Clock | None = None
        for _ in range(PINGS if found is not None else 0):
            sent_s = time.time()
            try:
                answer = await self.agent.mesh.query(PING.of(zid=found.zid), b"", timeout_s=self.timeout_s)  # type: ignore[union-attr]
                said, _ = ping.decode(answer)
            except MacsError:
                return best
            heard_s = time.time()
            clock = Clock(said.time_s - (sent_s + heard_s) / 2, (heard_s - sent_s) / 2)
            best = clock if best is None or clock.within_s < best.within_s else best
        return best


async def _each(robots: Iterable[int], answers: Iterable[Awaitable[_T]]) -> dict[int, _T]:
    """What each robot told; of those that did not it is logged why."""
    told: dict[int, _T] = {}
    for robot, answer in zip(robots, await asyncio.gather(*answers, return_exceptions=True), strict=True):
        if isinstance(answer, MacsError):
            log.warning("robot %d does not tell what it has: %s", robot, answer)
        elif isinstance(answer, BaseException):
            raise answer
        else:
            told[robot] = answer
    return told


def type_of(name: str, kind: NodeType, offers: Mapping[int, Offered]) -> str:
    """The type of a topic or service, as these robots have it. Raises Unreachable, UsageError."""
    return type_behind(name, kind, offers.values())


def type_of_action(name: str, offers: Mapping[int, Offered]) -> str:
    """The same for an action."""
    name = absolute(name)
    found = {offered.actions[name] for offered in offers.values() if name in offered.actions}
    if len(found) > 1:
        raise UsageError(f"{name} has types {' and '.join(sorted(found))}: say which one is meant")
    if found:
        return found.pop()
    near = closest(name, {known for offered in offers.values() for known in offered.actions})
    meant = f"; did you mean {near}?" if near else "."
    raise Unreachable(f"action {name}", f"no robot offers it{meant} Or say its type, as pkg/Name")


def named(robots: Collection[int]) -> str:
    """``robot 7`` or ``robots 7, 8``."""
    return f"robot{'' if len(robots) == 1 else 's'} {', '.join(map(str, sorted(robots)))}"


def refusal(reasons: Mapping[int, str]) -> Refused:
    """What robots said, in one line."""
    return Refused("; ".join(f"robot {robot}: {why}" for robot, why in sorted(reasons.items())))
