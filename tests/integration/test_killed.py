"""Who is killed is gone from everybody's sight within a second: a ROS node, a program, a router."""

from __future__ import annotations

import asyncio
import signal
import sys
import time
from collections.abc import Callable
from contextlib import AsyncExitStack
from pathlib import Path

import pytest

import macs_zenoh
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh.ros_network import RosNetwork
from macs_zenoh.protocol.messages import UNITY, Configuration, encode_management
from macs_zenoh.protocol.wire import encode_frame
from tests.support.processes import Process
from tests.support.programs import Program
from tests.support.routers import Router
from tests.support.waiting import until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = [pytest.mark.timeout(300), pytest.mark.alone]

GONE_S = 1.0
"""By when who was killed is gone; on a quiet machine it takes 0.3 s."""

SETTINGS = """
[[rmw_zenoh.robots]]
id = 7
node_namespace = "/robot7"
"""

NODE = """
import asyncio, sys
from macs_zenoh import ros

async def main():
    async with ros.node("base", namespace="/robot7", connect=[sys.argv[1]]) as node:
        node.publisher("odom", "std_msgs/String")
        print("ready: base", flush=True)
        await asyncio.Event().wait()

asyncio.run(main())
"""


async def gone(killed: Process, sees: Callable[[], bool]) -> float:
    """How long somebody is seen who is killed."""
    assert sees()
    began = time.monotonic()
    killed.send_signal(signal.SIGKILL)
    await until(lambda: not sees(), every_s=0.01)
    return time.monotonic() - began


@pytest.mark.parametrize("dies", ["node", "program", "its router"])
async def test_a_robot_of_rmw_zenoh(tmp_path: Path, dies: str) -> None:
    """Behind a router of its own, seen behind another one: by agents, and its node by who follows ROS."""
    settings = tmp_path / "robots.toml"
    settings.write_text(SETTINGS, encoding="utf-8")
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        site = await enter(Router())
        its = await enter(Router(connect=[site.endpoint]))
        program = await enter(Program("rmw-zenoh", "--settings", str(settings), "-e", its.endpoint))
        node = await enter(Process(sys.executable, "-c", NODE, its.endpoint))
        agent = await enter(macs_zenoh.join("unity", id=300, connect=[site.endpoint]))
        network = await enter(await RosNetwork.open(MeshSettings(connect=[site.endpoint])))
        await network.known(0)

        def robot() -> bool:
            return agent.directory.ids(1) == [7]

        def ghost() -> bool:
            return "base" in {each.name for each in network.graph(0).nodes(others=True)}

        await until(robot)
        await until(ghost)
        killed: Process = {"node": node, "program": program, "its router": its}[dies]
        seen = [
            asyncio.create_task(gone(killed, sees)) for sees in ((robot,) if dies == "program" else (robot, ghost))
        ]
        assert max(await asyncio.gather(*seen)) <= GONE_S


async def test_a_gateway_with_its_headset() -> None:
    """For an agent behind another router."""
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        site = await enter(Router())
        its = await enter(Router(connect=[site.endpoint]))
        gateway = await enter(Program("gateway", "--port", "0", "-e", its.endpoint))
        agent = await enter(macs_zenoh.join("ros", id=7, connect=[site.endpoint]))
        _, writer = await asyncio.open_connection("127.0.0.1", gateway.port)
        writer.write(encode_frame(management=encode_management(Configuration(UNITY, 0))))
        await until(lambda: len(agent.directory.ids(UNITY)) == 1)
        assert await gone(gateway, lambda: bool(agent.directory.ids(UNITY))) <= GONE_S
        writer.close()
