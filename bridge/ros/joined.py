"""A robot on the mesh, whoever speaks to its ROS graph."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from functools import partial

from bridge import link_bytes
from bridge.ros.agent import STOP_MESSAGES_S, RobotAgent
from bridge.ros.pictures import Pictures, check_installed
from bridge.ros.safety import EmergencyStop
from bridge.ros.side import Side
from bridge.settings import Settings
from macs_zenoh import joining, managers
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.guard import Guard, Limits
from macs_zenoh.protocol.keyexpr import type_number
from macs_zenoh.protocol.messages import NodeType
from macs_zenoh.protocol.wire import Layout

log = logging.getLogger("macs.ros")


@asynccontextmanager
async def joined(
    settings: Settings,
    session: Side,
    *,
    on_waiting: Callable[[str], None] | None = None,
    emergency_stop: EmergencyStop | None = None,
    mesh: Mesh | None = None,
) -> AsyncIterator[RobotAgent]:
    """Join the mesh as the robot whose ROS graph this is, and serve until the end of the block.

    ``mesh``: over this one, which is open already.

    Raises ConfigError, MissingExtra; what `macs_zenoh.join` raises.
    """
    robot = settings.robot
    check_installed(robot)
    own = managers.load(robot.managers)
    guard = Guard(
        Limits(
            robot.max_commands_per_s,
            robot.max_requests_per_s,
            robot.max_command_age_s,
            robot.max_timed_command_age_s,
        ),
        Layout(settings.mesh.id_slots, settings.mesh.group_slots),
    )
    kind = type_number("ros")
    async with AsyncExitStack() as stack:
        if mesh is None:
            opened = await Mesh.open(settings.mesh, traffic=settings.traffic, on_waiting=on_waiting)
            mesh = await stack.enter_async_context(opened)
        as_robot = joining.joined(mesh, kind, id=robot.id, group=robot.group, guard=guard)
        agent = await stack.enter_async_context(as_robot)
        link_bytes.tell_of(agent.mesh)
        ros_agent = RobotAgent(agent, session, robot, own, guard, emergency_stop)
        await ros_agent.start()
        pictures = Pictures(ros_agent.nodes.robot, partial(_tell, asyncio.get_running_loop(), ros_agent))
        stack.push_async_callback(asyncio.sleep, STOP_MESSAGES_S)
        stack.push_async_callback(pictures.close)
        stack.push_async_callback(ros_agent.close)  # first, and whatever fails: what moves is stopped
        pictures.start()
        log.info("robot %d serves %s", agent.id, session.full_name)
        yield ros_agent


def _tell(loop: asyncio.AbstractEventLoop, robot: RobotAgent, topic: str, kind: str, reason: str) -> None:
    """Tell who registered for a topic what is wrong with it. From any thread."""

    def tell() -> None:
        for node in robot.nodes:
            if node.NODE_TYPE == NodeType.SUBSCRIBER and node.topic == topic:
                node.tell_registrants(kind, reason)

    with suppress(RuntimeError):  # the loop has ended
        loop.call_soon_threadsafe(tell)
