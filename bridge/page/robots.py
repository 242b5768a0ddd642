"""What is shown of robots: their state and what they offer, asked of each once for all pages of a gateway."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from functools import partial
from typing import Any

from macs_zenoh.errors import MacsError, Refused, Unreachable, WireError
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.json_fields import answered
from macs_zenoh.protocol.messages import ROS, UNITY, Metadata
from macs_zenoh.protocol.rights import Grant
from macs_zenoh.protocol.routing import call
from macs_zenoh.protocol.wire import Layout

from .fresh import Fresh

CALLER = (UNITY, 0)
"""As whom a gateway asks for its pages: a headset that has not joined."""
ASK_S = 2.0
STATUS_GOOD_S = 0.5
OFFERS_GOOD_S = 1.0
AT_ONCE = 32
"""So many robots are asked at one time."""
PER_S = 100.0
"""Questions for all robots together, when many of them are looked at."""
FORGET_S = 60.0
"""A robot that nobody has looked at for so long is forgotten."""


class Robots:
    """The robots that pages of this gateway look at."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._layout = Layout(mesh.settings.id_slots, mesh.settings.group_slots)
        self._room = asyncio.Semaphore(AT_ONCE)
        self._asked: dict[tuple[int, str], Fresh[dict[str, Any]]] = {}

    async def ask(self, robot: int, verb: str, data: bytes = b"") -> bytes:
        """What a robot answers. Raises Refused, Unreachable."""
        key, frame = call((ROS, robot), verb, CALLER, data, Metadata(*CALLER), self._layout)
        async with self._room:
            return await self._mesh.query(key, frame, timeout_s=ASK_S)

    async def status(self, robot: int) -> dict[str, Any]:
        """`robot_state.RobotStatus` as JSON has it. Raises Refused, Unreachable."""
        return await self._fresh(robot, "status", STATUS_GOOD_S).now()

    async def offers(self, robot: int) -> dict[str, Any]:
        """`robot_state.Offered`, likewise."""
        return await self._fresh(robot, "offers", OFFERS_GOOD_S).now()

    def known(self, robots: Iterable[int]) -> dict[int, dict[str, Any]]:
        """The state of each as far as it is known now; those that are not are asked meanwhile."""
        wanted = list(robots)
        good_s = max(2 * STATUS_GOOD_S, len(wanted) / PER_S)
        self._forget()
        found = {}
        for robot in wanted:
            status = self._fresh(robot, "status", STATUS_GOOD_S).last(good_s)
            if status is not None:
                found[robot] = status
        return found

    def close(self) -> None:
        """Ask nobody any more."""
        for fresh in self._asked.values():
            fresh.close()

    def _fresh(self, robot: int, verb: str, good_s: float) -> Fresh[dict[str, Any]]:
        fresh = self._asked.get((robot, verb))
        if fresh is None:
            self._forget()
            fresh = self._asked[robot, verb] = Fresh(partial(self._ask_json, robot, verb), good_s)
        return fresh

    def _forget(self) -> None:
        now = asyncio.get_running_loop().time()
        for key, fresh in list(self._asked.items()):
            if now - fresh.wanted_at > FORGET_S:
                fresh.close()
                del self._asked[key]

    async def _ask_json(self, robot: int, verb: str) -> dict[str, Any]:
        try:
            return answered("an answer", await self.ask(robot, verb))
        except WireError as error:
            raise Unreachable(f"robot {robot}", f"its answer makes no sense: {error}") from error


def may_see(visitor: Grant, robot: int, group: int) -> bool:
    """Whether who asks may be told of a robot of this group."""
    rights = visitor.rights
    return rights is None or (rights.has("see") and rights.sees(robot, group))


def problem_of(error: MacsError) -> str:
    """Why a robot told nothing, for a person."""
    return error.reason if isinstance(error, Refused) else str(error)
