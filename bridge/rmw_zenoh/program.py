"""Robots that run rmw_zenoh, on the mesh while their nodes live: `macs rmw-zenoh`."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from contextlib import AsyncExitStack, suppress

from msgspec import structs

from bridge.rmw_zenoh.robots import nodes_of, seen
from bridge.rmw_zenoh.session import ZenohSession
from bridge.rmw_zenoh.types import KnownTypes
from bridge.ros.joined import joined
from bridge.ros.safety import EmergencyStop
from bridge.settings import Settings
from bridge.settings.rmw_zenoh import RmwZenohRobot
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import MacsError
from macs_zenoh.locked_out import locked_out
from macs_zenoh.mesh.ros_network import RosNetwork
from macs_zenoh.protocol.rmw_zenoh.attachment import gid_of
from macs_zenoh.protocol.rmw_zenoh.keyexpr import BadToken, Endpoint, Node, parse_token
from macs_zenoh.sections import changed

log = logging.getLogger("macs.ros")

GONE_S = 0.3
"""A robot without a node for so long has left. Nodes that start again, and a router, take less."""
AGAIN_S = 2.0
"""After so long a robot that could not join tries again."""


def ros_settings(settings: Settings, session_namespace: str = "") -> MeshSettings:
    """How to reach the routers of the robots' nodes: as the mesh's, unless the settings name others."""
    mesh = changed(settings.mesh, connect=settings.rmw_zenoh.connect or None)
    return structs.replace(mesh, namespace=session_namespace or None)


class ZenohRobot:
    """One robot: it joins the mesh when its first node is there, and leaves it after the last."""

    def __init__(self, settings: Settings, robot: RmwZenohRobot, network: RosNetwork) -> None:
        own = changed(settings.robot, id=robot.id, group=robot.group)
        self._settings = changed(settings, robot=own)
        self.robot = robot
        self.network = network
        self._loop = asyncio.get_running_loop()
        self._graph = network.graph(robot.domain)
        self._looked = asyncio.Event()
        self._stop = EmergencyStop()
        """It holds, however often the robot leaves and comes back."""
        self._watching = network.on_change(self._changed)

    async def run(self) -> None:
        """Be that robot while its nodes live, until the task is cancelled."""
        try:
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
            async with joined(self._settings, session, emergency_stop=self._stop) as agent:
                log.info("robot %d is there: %s", self.robot.id, self.robot.place)
                leaving = [
                    asyncio.ensure_future(self._until_gone()),
                    asyncio.ensure_future(locked_out(agent.agent.mesh)),
                ]
                try:
                    await asyncio.wait(leaving, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    for reason in leaving:
                        reason.cancel()
            log.info("robot %d has left", self.robot.id)
        finally:
            await asyncio.to_thread(session.close)

    async def _until_gone(self) -> None:
        while True:
            await self._until(lambda: not self.is_there)
            await asyncio.sleep(GONE_S)
            if not self.is_there:
                return

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
    on_waiting: Callable[[str], None] | None = None,
    on_ready: Callable[[list[RmwZenohRobot]], None] | None = None,
) -> None:
    """Present the robots of the settings until the task is cancelled.

    Raises ConfigError; MissingExtra and UnknownType, for what is missing here.
    """
    gid_of("")  # what is missing here is told now, and not when the first node comes
    await asyncio.to_thread(KnownTypes, settings.rmw_zenoh.definitions)
    robots = settings.rmw_zenoh.robots
    async with AsyncExitStack() as stack:
        networks: dict[str, RosNetwork] = {}
        for robot in robots:
            name = robot.session_namespace
            if name not in networks:
                opened = await RosNetwork.open(ros_settings(settings, name), on_waiting=on_waiting)
                networks[name] = await stack.enter_async_context(opened)
        serving = [
            asyncio.ensure_future(ZenohRobot(settings, robot, networks[robot.session_namespace]).run())
            for robot in robots
        ]
        try:
            if on_ready is not None:
                on_ready(robots)
            await asyncio.gather(*serving)
        finally:
            for one in serving:
                one.cancel()
            await asyncio.gather(*serving, return_exceptions=True)


async def look(settings: Settings, *, within_s: float) -> list[RmwZenohRobot]:
    """Robots by rule, as far as their nodes are seen within this time. Raises ConfigError."""
    async with await RosNetwork.open(ros_settings(settings)) as network:
        nodes: dict[str, Node] = {}

        def token(text: str, alive: bool) -> None:
            with suppress(BadToken):
                found = parse_token(text)
                if alive and isinstance(found, Node):
                    nodes[text] = found

        watching = network.watch_tokens(None, token)
        try:
            await asyncio.sleep(within_s)
        finally:
            watching.close()
        return list(seen(settings.rmw_zenoh, list(nodes.values())))


def shown(robots: Iterable[RmwZenohRobot]) -> list[str]:
    """Robots, one a line."""
    return [f"robot {robot.id}: {robot.place}" for robot in robots]
