"""Robots that run rmw_zenoh, on the mesh while their nodes live: `macs rmw-zenoh`."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping
from contextlib import AbstractAsyncContextManager, AsyncExitStack, suppress

from msgspec import structs

from bridge.rmw_zenoh.robots import Place, Robots, nodes_of
from bridge.rmw_zenoh.session import ZenohSession
from bridge.rmw_zenoh.types import KnownTypes
from bridge.ros.agent import RobotAgent
from bridge.ros.joined import joined
from bridge.ros.safety import EmergencyStop
from bridge.settings import Settings
from bridge.settings.rmw_zenoh import RmwZenohRobot, RmwZenohSettings
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import ConfigError, MacsError
from macs_zenoh.handles import Handle
from macs_zenoh.locked_out import locked_out
from macs_zenoh.mesh import Mesh
from macs_zenoh.mesh.panics import unwatched
from macs_zenoh.mesh.ros_network import RosNetwork
from macs_zenoh.protocol.messages import ROS
from macs_zenoh.protocol.rmw_zenoh.attachment import gid_of
from macs_zenoh.protocol.rmw_zenoh.graph import TOKENS
from macs_zenoh.protocol.rmw_zenoh.keyexpr import BadToken, Endpoint, Node, parse_token
from macs_zenoh.sections import changed
from macs_zenoh.timeouts import within

log = logging.getLogger("macs.ros")

GONE_S = 0.3
"""A robot without a node for so long has left. Nodes that start again, and a router, take less."""
HIDDEN_S = 60.0
"""So long a robot that is out of sight, since the way to its router was lost, has what agents registered on it."""
LOOK_S = 5.0
"""How long the router may take to tell which nodes are there."""
SETTLE_S = 0.2
"""Nodes that start together are seen together: in which namespaces they are says which robots there are."""
AGAIN_S = 2.0
"""After so long a robot that could not join tries again."""


def ros_settings(settings: Settings, session_namespace: str = "") -> MeshSettings:
    """How to reach the routers of the robots' nodes: as the mesh's, unless the settings name others."""
    mesh = changed(settings.mesh, connect=settings.rmw_zenoh.connect or None)
    return structs.replace(mesh, namespace=session_namespace or None)


class ZenohRobot:
    """One robot: it joins the mesh when its first node is there, and leaves it after the last."""

    def __init__(self, settings: Settings, robot: RmwZenohRobot, network: RosNetwork, stop: EmergencyStop) -> None:
        """``stop`` holds, however often the robot leaves and comes back."""
        own = changed(settings.robot, id=robot.id, group=robot.group)
        self._settings = changed(settings, robot=own)
        self.robot = robot
        self.network = network
        self._loop = asyncio.get_running_loop()
        self._graph = network.graph(robot.domain)
        self._looked = asyncio.Event()
        self._stop = stop
        self._watching = network.on_change(self._changed)

    async def run(self, before: Collection[asyncio.Future[None]] = ()) -> None:
        """Be that robot while its nodes live, until the task is cancelled. It begins when those before it have
        ended."""
        try:
            if before:
                await asyncio.wait(before)
            while True:
                await self._until(lambda: self.is_there)
                try:
                    await self._be_there()
                except MacsError as error:
                    log.error("robot %d cannot join: %s", self.robot.id, error)
                    await asyncio.sleep(AGAIN_S)
        finally:
            self._watching.close()

    @property
    def is_there(self) -> bool:
        """Whether a node of the robot's lives."""
        return bool(nodes_of(self.robot, self._graph))

    async def _be_there(self) -> None:
        types = await asyncio.to_thread(KnownTypes, self._settings.rmw_zenoh.definitions)
        session = ZenohSession(
            self.network,
            types,
            domain=self.robot.domain,
            namespace=self.robot.node_namespace,
            own_names=[self._settings.robot.stop_topic] if self._settings.robot.stop_topic else [],
        )
        try:
            async with AsyncExitStack() as stack:
                mesh = await stack.enter_async_context(self._mesh()) if self.network.is_router else None
                await self._join(joined(self._settings, session, emergency_stop=self._stop, mesh=mesh))
            log.info("robot %d has left", self.robot.id)
        finally:
            await asyncio.to_thread(session.close)

    def _mesh(self) -> Mesh:
        """The mesh over the session of a router, which is the nodes' as well: nothing in between."""
        return Mesh.over(unwatched(self.network.session), self._settings.mesh, self._settings.traffic)

    async def _join(self, as_robot: AbstractAsyncContextManager[RobotAgent]) -> None:
        async with as_robot as agent:
            log.info("robot %d is there: %s", self.robot.id, self.robot.place)
            leaving = [
                asyncio.ensure_future(self._until_gone(agent.agent)),
                asyncio.ensure_future(locked_out(agent.agent.mesh)),
            ]
            try:
                await asyncio.wait(leaving, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for reason in leaving:
                    reason.cancel()

    async def _until_gone(self, agent: Agent) -> None:
        while True:
            losses = self.network.losses
            await self._until(lambda: not self.is_there)
            await asyncio.sleep(GONE_S)
            if self.is_there:
                continue
            agent.show(False)  # whatever it takes to leave
            if self.network.linked and self.network.losses == losses:
                return
            log.warning("robot %d is out of sight: the way to the router of its nodes is lost", self.robot.id)
            with suppress(asyncio.TimeoutError):
                await within(self._until(lambda: self.is_there), HIDDEN_S)
            others = {each.zid for each in agent.directory.claimants(ROS, agent.id)} - {agent.mesh.zid}
            if others or not self.is_there:
                return
            agent.show(True)
            log.info("robot %d is in sight again", self.robot.id)

    async def _until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            self._looked.clear()
            if not condition():
                await self._looked.wait()

    def _changed(self, found: Node | Endpoint, _alive: bool) -> None:
        if isinstance(found, Node):
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._looked.set)


async def run(
    settings: Settings,
    *,
    follow: bool = False,
    on_waiting: Callable[[str], None] | None = None,
    on_ready: Callable[[list[RmwZenohRobot]], None] | None = None,
) -> None:
    """Present the robots of the settings until the task is cancelled; ``follow``: and those by rule, as they come.

    Raises ConfigError; MissingExtra and UnknownType, for what is missing here.
    """
    gid_of("")  # what is missing here is told now, and not when the first node comes
    await asyncio.to_thread(KnownTypes, settings.rmw_zenoh.definitions)
    robots = settings.rmw_zenoh.robots
    if settings.mesh.mode == "router":
        _check_router(settings)
    async with AsyncExitStack() as stack:
        networks: dict[str, RosNetwork] = {}
        for name in dict.fromkeys([robot.session_namespace for robot in robots] + [""] * follow):
            opened = await RosNetwork.open(ros_settings(settings, name), on_waiting=on_waiting)
            networks[name] = await stack.enter_async_context(opened)
        presented = await stack.enter_async_context(_Presented(settings, networks))
        presented.are(robots)
        if follow:
            following = await _Following.begin(settings.rmw_zenoh, networks[""])
            stack.callback(following.close)
            presented.are(robots := following.robots())
        if on_ready is not None:
            on_ready(robots)
        while follow:
            await presented.until(following.change())
            await asyncio.sleep(SETTLE_S)
            presented.are(following.robots())
        await presented.until(asyncio.get_running_loop().create_future())


def _check_router(settings: Settings) -> None:
    """As a router there is one session for the nodes and for the mesh. Raises ConfigError."""
    for name, given in (
        ("namespace", settings.mesh.namespace),
        ("rmw_zenoh.connect", settings.rmw_zenoh.connect),
        ("session_namespace", any(robot.session_namespace for robot in settings.rmw_zenoh.robots)),
    ):
        if given:
            raise ConfigError(
                name, "with mode router there is one session, the nodes' and the mesh's, and no such thing"
            )


class _Presented:
    """The robots that are presented now, each in a task of its own."""

    def __init__(self, settings: Settings, networks: Mapping[str, RosNetwork]) -> None:
        self._settings = settings
        self._networks = networks
        self._tasks: dict[RmwZenohRobot, asyncio.Task[None]] = {}
        self._ending: dict[asyncio.Task[None], int] = {}
        """Those that are leaving, and their ids: who has the id now waits for them."""
        self._stops: dict[int, EmergencyStop] = {}
        """By id: a stop holds also where the id has become that of other nodes."""

    async def __aenter__(self) -> _Presented:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.are([])
        await asyncio.gather(*self._ending, return_exceptions=True)

    def are(self, robots: Iterable[RmwZenohRobot]) -> None:
        """Present these, and no others."""
        wanted = list(robots)
        for robot in [robot for robot in self._tasks if robot not in wanted]:
            task = self._tasks.pop(robot)
            task.cancel()
            self._ending[task] = robot.id
            task.add_done_callback(self._ended)
        for robot in wanted:
            if robot not in self._tasks:
                stop = self._stops.setdefault(robot.id, EmergencyStop())
                one = ZenohRobot(self._settings, robot, self._networks[robot.session_namespace], stop)
                before = [task for task, its_id in self._ending.items() if its_id == robot.id]
                self._tasks[robot] = asyncio.ensure_future(one.run(before))

    def _ended(self, task: asyncio.Task[None]) -> None:
        del self._ending[task]

    async def until(self, something: Awaitable[None]) -> None:
        """Wait for it. Raises what ends a robot for good."""
        waiting = asyncio.ensure_future(something)
        try:
            await asyncio.wait({waiting, *self._tasks.values()}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            waiting.cancel()
        for task in self._tasks.values():
            if task.done():
                task.result()


class _Following:
    """Robots by rule, as far as their nodes are seen."""

    def __init__(self, settings: RmwZenohSettings) -> None:
        self._robots = Robots(settings)
        self._nodes: dict[str, Node] = {}
        self._lock = threading.Lock()
        self._loop = asyncio.get_running_loop()
        self._changed = asyncio.Event()
        self._told: set[Place] = set()
        self._watching: Handle | None = None

    @classmethod
    async def begin(cls, settings: RmwZenohSettings, network: RosNetwork) -> _Following:
        """Follow; who is there now is known."""
        following = cls(settings)
        following._watching = await network.follow_tokens(None, following._token, timeout_s=LOOK_S)
        await asyncio.sleep(SETTLE_S)
        return following

    def close(self) -> None:
        """Follow no more."""
        if self._watching is not None:
            self._watching.close()

    def robots(self) -> list[RmwZenohRobot]:
        """Those that there are, or were."""
        self._changed.clear()
        with self._lock:
            nodes = list(self._nodes.values())
        found = self._robots.look(nodes)
        for place, problem in self._robots.refused.items():
            if place not in self._told:
                self._told.add(place)
                log.warning("nodes in domain %d, namespace %s are no robot: %s", *place, problem)
        return found

    async def change(self) -> None:
        """Wait until a node comes or goes."""
        await self._changed.wait()

    def _token(self, text: str, alive: bool) -> None:
        """In a thread of Zenoh's."""
        with suppress(BadToken):
            found = parse_token(text)
            if isinstance(found, Node):
                with self._lock:
                    if not alive:
                        self._nodes.pop(text, None)
                    elif len(self._nodes) < TOKENS:
                        self._nodes[text] = found
                with suppress(RuntimeError):  # the loop has ended
                    self._loop.call_soon_threadsafe(self._changed.set)


async def look(settings: Settings) -> list[RmwZenohRobot]:
    """The robots of the settings, and those by rule as far as their nodes are seen now. Raises ConfigError."""
    async with await RosNetwork.open(ros_settings(settings)) as network:
        following = await _Following.begin(settings.rmw_zenoh, network)
        following.close()
        return following.robots()


def shown(robots: Iterable[RmwZenohRobot]) -> list[str]:
    """Robots, one a line."""
    return [f"robot {robot.id}: {robot.place}" for robot in robots]
