"""Looks at a mesh without joining it: who is online as it changes, and what robots, gateways and routers answer.

It asks so little that a mesh does not notice: each robot at most once a second, all together a bounded number of
times, and each program of the mesh every few seconds.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress

from bridge.cli import robots
from bridge.cli.robots import Operator
from bridge.graph.links import Routers
from macs_zenoh.errors import MacsError, NotServed, Refused, Unreachable
from macs_zenoh.mesh import Mesh
from macs_zenoh.presence import Presence
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.directory import Change
from macs_zenoh.protocol.keyexpr import PING
from macs_zenoh.protocol.ping import Pong
from macs_zenoh.protocol.robot_state import RobotStatus

from .events import Event
from .picture import Picture

log = logging.getLogger("macs.top")

ROBOT_EVERY_S = 1.0
STATES_PER_S = 60
"""Of all robots together: with two hundred of them each is asked every three seconds and more."""
PROGRAMS_EVERY_S = 2.0
ROUTERS_EVERY_S = 5.0
ANSWER_S = 2.0

OnEvents = Callable[[list[Event]], None]


class Observer:
    """Keeps a `Picture` up to date until it is cancelled. ``on_events`` hears of what changes, once all was seen."""

    def __init__(self, mesh: Mesh, operator: Operator, on_events: OnEvents, admin: Mesh | None = None) -> None:
        """``admin`` is a session without the namespace that ``mesh`` may have: routers tell of themselves in none."""
        self.picture = Picture()
        self._admin = admin or mesh
        self._known = Routers(self._admin)
        self._mesh = mesh
        self._operator = operator
        self._on_events = on_events
        self._presence = Presence(mesh, self._changed, lambda contested: None)
        self._began = False
        self._asked_s: dict[int, float] = {}
        self._asking: set[int] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._link = mesh.on_link(self._linked)

    async def begin(self) -> None:
        """See who is there, and ask everybody once; nobody hears of that as of something that has changed."""
        await self._presence.start()
        await asyncio.gather(self._programs(), self._routers())
        first = list(self.picture.robots)[:STATES_PER_S]
        await asyncio.gather(*map(self._state, first))
        self._began = True

    async def run(self) -> None:
        """Go on looking. `begin` comes first."""
        try:
            await asyncio.gather(
                self._states(),
                self._again(self._programs, PROGRAMS_EVERY_S),
                self._again(self._routers, ROUTERS_EVERY_S),
            )
        finally:
            for task in self._tasks:
                task.cancel()

    def close(self) -> None:
        """Look no more."""
        self._link.close()
        self._presence.close()

    # -- what changes --------------------------------------------------------------------------------------------

    def _changed(self, changes: list[Change]) -> None:
        at_s = time.time()
        self._tell([event for change in changes for event in self.picture.presence(change, at_s)])

    def _linked(self, up: bool) -> None:
        if not up and self._mesh.linked:
            return  # another router is left
        text = "our own router is back" if up else "our own router is lost: what happens meanwhile is not seen"
        self._tell([Event(time.time(), "came" if up else "left", "router", text)])

    def _tell(self, events: list[Event]) -> None:
        if events and self._began:
            self._on_events(events)

    async def _again(self, look: Callable[[], Awaitable[None]], every_s: float) -> None:
        while True:
            await asyncio.sleep(every_s)
            with suppress(MacsError):
                await look()

    # -- robots --------------------------------------------------------------------------------------------------

    async def _states(self) -> None:
        """Ask who has not been asked for longest, so many a second."""
        loop = asyncio.get_running_loop()
        while True:
            now = time.monotonic()
            self._asked_s = {robot: at for robot, at in self._asked_s.items() if robot in self.picture.robots}
            due = sorted(
                (self._asked_s.get(robot, 0.0), robot)
                for robot in self.picture.robots
                if now - self._asked_s.get(robot, 0.0) >= ROBOT_EVERY_S and robot not in self._asking
            )
            for _, robot in due[: STATES_PER_S // 10]:
                self._tasks.add(task := loop.create_task(self._state(robot)))
                task.add_done_callback(self._tasks.discard)
            await asyncio.sleep(0.1)

    async def _state(self, robot: int) -> None:
        began = self._asked_s[robot] = time.monotonic()
        self._asking.add(robot)
        try:
            answer = await self._operator.ask(robot, "status", timeout_s=ANSWER_S)
            status = robots.read(answer, RobotStatus)[1]
        except (NotServed, Refused):  # an existing program, or it has just come, or others may ask
            return
        except MacsError as error:
            why = error.why if isinstance(error, Unreachable) else str(error)
            self._tell(self.picture.silent(robot, why, time.time()))
        else:
            now = time.monotonic()
            self._tell(self.picture.told(robot, status, now - began, now, time.time()))
        finally:
            self._asking.discard(robot)

    # -- programs ------------------------------------------------------------------------------------------------

    async def _programs(self) -> None:
        zids = sorted(await self._operator.gateways())
        pongs = dict(zip(zids, await asyncio.gather(*map(self._pong, zids)), strict=True))
        self._tell(self.picture.gateways(pongs, time.time()))

    async def _pong(self, zid: str) -> tuple[Pong, float] | None:
        began = time.monotonic()
        try:
            answer = await self._mesh.query(PING.of(zid=zid), ping.AGENTS, timeout_s=ANSWER_S)
            pong, told = ping.decode(answer)
            self._tell(self.picture.told_by_gateway(zid, ping.decode_told(told), time.time()))
        except MacsError:
            return None
        return pong, time.monotonic() - began

    async def _routers(self) -> None:
        found = await self._known.look()
        self._tell(self.picture.routers(found, self._admin.routers, self._known.trips, time.time()))
