"""The robot agent: an agent of type ``ros`` on the mesh that serves registrations of interface nodes.

Verbs: ``add_node`` (data: AddNode) and ``remove_node`` (RemoveNode), answered with nothing or a refusal that says why;
``offers`` (no data), answered with Functionality.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager

import macs_zenoh
from bridge.ros import graph
from bridge.ros.nodes import InterfaceNodes, Registrant, Robot
from bridge.ros.session import RosSession
from macs_zenoh.agent import Agent, Call, Message
from macs_zenoh.config import RobotSettings, Settings
from macs_zenoh.directory import AgentInfo
from macs_zenoh.messages import AddNode, RemoveNode, decode_data, encode_data
from macs_zenoh.wire import Layout

log = logging.getLogger("macs.ros")

NODE_NAME = "rosagent"


class RobotAgent:
    """Connects an agent on the mesh with a ROS session. Made by `open_robot`."""

    def __init__(self, agent: Agent, session: RosSession, settings: RobotSettings) -> None:
        self.agent = agent
        self.session = session
        layout = Layout(agent.mesh.settings.id_slots, agent.mesh.settings.group_slots)
        self.nodes = InterfaceNodes(
            Robot(session, agent.id, agent.publish_stream, layout), max_nodes=settings.max_nodes
        )
        agent.serve("add_node", self._add_node)
        agent.serve("remove_node", self._remove_node)
        agent.serve("offers", self._offers)
        agent.on_presence(self._presence)

    async def work(self) -> None:
        """Pass messages to their nodes until the agent leaves the mesh."""
        async for message in self.agent:
            try:
                self._take(message)
            except Exception:
                # a message that hits a fault of ours must not make the robot deaf for all that follow
                log.exception("a message from %s/%d failed", message.sender_type, message.sender_id)

    def _take(self, message: Message) -> None:
        if message.metadata.node_name:
            self.nodes.deliver(message)
        else:
            log.debug("a message for %r, which is not for robots", message.metadata.message_manager[:80])

    async def _add_node(self, call: Call) -> bytes:
        await self.nodes.add(decode_data(AddNode, call.data))
        return b""

    async def _remove_node(self, call: Call) -> bytes:
        self.nodes.remove(decode_data(RemoveNode, call.data))
        return b""

    async def _offers(self, _call: Call) -> bytes:
        return encode_data(await self.session.run(lambda: graph.offers(self.session.node)))

    def _presence(self, agent: AgentInfo, online: bool) -> None:
        if not online:
            self.nodes.forget(Registrant(agent.type, agent.id))


@asynccontextmanager
async def open_robot(
    settings: Settings,
    *,
    domain_id: int | None = None,
    ros_args: Sequence[str] = (),
    on_waiting: Callable[[str], None] | None = None,
) -> AsyncIterator[RobotAgent]:
    """Start ROS, join the mesh and serve until the end of the block.

    Args:
        settings: the id and group of the robot and how to reach the mesh.
        domain_id: None takes ``ROS_DOMAIN_ID``.
        ros_args: ROS arguments, as ``["--ros-args", "-r", "__ns:=/robot7"]``.
        on_waiting: called once while no router answers.

    Raises Unreachable when ROS cannot start; what `macs_zenoh.join` raises.
    """
    robot = settings.robot
    session = await asyncio.to_thread(RosSession, NODE_NAME, domain_id=domain_id, ros_args=ros_args)
    try:
        async with macs_zenoh.join(
            "ros", id=robot.id, group=robot.group, settings=settings.mesh, on_waiting=on_waiting
        ) as agent:
            ros_agent = RobotAgent(agent, session, robot)
            work = asyncio.create_task(ros_agent.work())
            log.info("robot %d serves %s", agent.id, session.full_name)
            try:
                yield ros_agent
            finally:
                work.cancel()
                ros_agent.nodes.close()
    finally:
        await asyncio.to_thread(session.close)


async def run(
    settings: Settings,
    *,
    ros_args: Sequence[str] = (),
    on_waiting: Callable[[str], None] | None = None,
    on_ready: Callable[[Agent], None] | None = None,
    stop: asyncio.Event | None = None,
) -> None:
    """Be a robot until ``stop`` is set or the task is cancelled. See `open_robot`."""
    async with open_robot(settings, ros_args=ros_args, on_waiting=on_waiting) as robot:
        if on_ready is not None:
            on_ready(robot.agent)
        await (stop or asyncio.Event()).wait()
