"""A robot as a program: ROS started, the mesh joined, and both anew when routers let its session in no more."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager

from bridge.metrics.endpoint import watched_at
from bridge.ros.agent import RobotAgent
from bridge.ros.figures import watched
from bridge.ros.joined import joined
from bridge.ros.safety import EmergencyStop
from bridge.settings import Settings
from macs_zenoh.agent import Agent
from macs_zenoh.locked_out import locked_out

NODE_NAME = "rosagent"


@asynccontextmanager
async def open_robot(
    settings: Settings,
    *,
    domain_id: int | None = None,
    ros_args: Sequence[str] = (),
    on_waiting: Callable[[str], None] | None = None,
    emergency_stop: EmergencyStop | None = None,
) -> AsyncIterator[RobotAgent]:
    """Start ROS, join the mesh and serve until the end of the block.

    Args:
        settings: the id and group of the robot and how to reach the mesh.
        domain_id: None takes ``ROS_DOMAIN_ID``.
        ros_args: ROS arguments, as ``["--ros-args", "-r", "__ns:=/robot7"]``.
        on_waiting: called once while no router answers.
        emergency_stop: its state, when the robot was there before: a stop holds however its sessions end.

    ROS parameters win over ``settings`` (see `parameters`).

    Raises Unreachable when ROS cannot start; ConfigError; what `macs_zenoh.join` raises.
    """
    import bridge.ros.installed  # noqa: F401 - says what to do where there is no rclpy
    from bridge.ros import parameters
    from bridge.ros.session import RosSession

    session = await asyncio.to_thread(RosSession, NODE_NAME, domain_id=domain_id, ros_args=ros_args)
    try:
        settings = await session.run(lambda: parameters.apply(session.node, settings))
        async with joined(settings, session, on_waiting=on_waiting, emergency_stop=emergency_stop) as robot:
            yield robot
    finally:
        await asyncio.to_thread(session.close)


async def run(
    settings: Settings,
    *,
    ros_args: Sequence[str] = (),
    on_waiting: Callable[[str], None] | None = None,
    on_ready: Callable[[Agent], None] | None = None,
    stop: asyncio.Event | None = None,
    metrics: str | None = None,
) -> None:
    """Be a robot until ``stop`` is set or the task is cancelled; with another session when routers do not let this one
    in any more (`macs_zenoh.locked_out`). See `open_robot`. At ``metrics``, HOST:PORT, it tells who watches it."""
    now: list[RobotAgent] = []
    async with watched_at(metrics, watched(lambda: now[-1] if now else None)):
        await _run(now, settings, ros_args, on_waiting, on_ready, stop or asyncio.Event())


async def _run(
    now: list[RobotAgent],
    settings: Settings,
    ros_args: Sequence[str],
    on_waiting: Callable[[str], None] | None,
    on_ready: Callable[[Agent], None] | None,
    stop: asyncio.Event,
) -> None:
    """`run`; ``now`` has the robot as long as it is on the mesh."""
    stopping = asyncio.ensure_future(stop.wait())
    emergency_stop = EmergencyStop()
    try:
        while not stopping.done():
            async with open_robot(
                settings, ros_args=ros_args, on_waiting=on_waiting, emergency_stop=emergency_stop
            ) as robot:
                if on_ready is not None:
                    on_ready(robot.agent)
                leaving = asyncio.ensure_future(locked_out(robot.agent.mesh))
                now[:] = [robot]
                try:
                    await asyncio.wait([stopping, leaving], return_when=asyncio.FIRST_COMPLETED)
                finally:
                    now.clear()
                    leaving.cancel()
    finally:
        stopping.cancel()
