"""A robot in a namespace of which next to nothing is open to agents: it can be stopped all the same."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack

import pytest

import macs_zenoh
from bridge.rmw_zenoh.session import ZenohSession
from bridge.rmw_zenoh.types import KnownTypes
from bridge.ros.joined import joined
from bridge.settings import RobotSettings, Settings
from macs_zenoh import ros
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh.ros_network import RosNetwork
from macs_zenoh.protocol.rmw_zenoh.qos import Durability, Qos
from tests.support.programs import ended
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
LATCHED = Qos(depth=1, durability=Durability.TRANSIENT_LOCAL)
pytestmark = pytest.mark.timeout(300)


async def test_the_emergency_stop_is_always_open(router: str) -> None:
    """With one topic exposed the stop, whose full name is below the robot's namespace, is there: agents may act, the
    stop stops them, and what is not exposed stays closed."""
    robot = RobotSettings(id=7, expose=["/robot7/cmd_vel"])
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=robot)
    async with AsyncExitStack() as stack:
        node = await stack.enter_async_context(ros.node("base", namespace="/robot7", connect=[router]))
        node.subscribe("cmd_vel", "geometry_msgs/Twist")
        states = node.subscribe("emergency_stop", "std_msgs/Bool", qos=LATCHED)
        network = await stack.enter_async_context(await RosNetwork.open(settings.mesh))
        types = await asyncio.to_thread(KnownTypes)
        session = ZenohSession(network, types, namespace="/robot7", own_names=[robot.stop_topic])
        stack.push_async_callback(asyncio.to_thread, session.close)
        served = await stack.enter_async_context(joined(settings, session))
        assert served.nodes.robot.no_stop == ""
        assert served.nodes.stop is not None
        assert served.nodes.stop.topic == "/robot7/emergency_stop"
        agent = await stack.enter_async_context(macs_zenoh.join("unity", id=300, connect=[router]))
        await until(lambda: agent.directory.ids(1) == [7], PATIENCE_S)
        drive = await agent.advertise("/robot7/cmd_vel", robot=7, type="geometry_msgs/Twist")
        refused: list[str] = []
        drive.on_refused(lambda _robot, reason: refused.append(reason))
        with pytest.raises(macs_zenoh.Refused, match="not open"):
            await agent.advertise("/robot7/other", robot=7, type="geometry_msgs/Twist")
        code, _, errors = await ended("stop", "7", "-e", router)
        assert code == 0, errors
        while not (await asyncio.wait_for(states.receive(), PATIENCE_S)).value["data"]:
            pass

        def refuses() -> bool:
            drive.publish({"linear": {"x": 0.5}})
            return any("stop holds" in reason for reason in refused)

        await until(refuses, PATIENCE_S, every_s=0.05)
