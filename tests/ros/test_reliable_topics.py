"""A kept topic from ROS to a headset while routers are killed: on the robot's side, on the gateway's, on both."""

from __future__ import annotations

import asyncio
import itertools
import signal
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack

import pytest
from std_msgs.msg import String

from bridge.gateway import Gateway
from bridge.headset.client import Headset
from bridge.ros.interface import Registrant, Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.program import open_robot
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.settings import GatewaySettings, RobotSettings, Settings, TopicRule
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.messages import NodeType
from tests.support.programs import free_port
from tests.support.ros_peer import Peer, adding
from tests.support.routers import Router
from tests.support.waiting import until

HZ = 100
AWAY_S = 4.0
"""Longer than the lease, so that each side has seen the other leave."""

RULES = [TopicRule(match="/log", cache=2000)]


@pytest.fixture
async def routers() -> AsyncIterator[dict[str, Router]]:
    """The robot's router and the gateway's, linked with each other."""
    first, second = [f"tcp/127.0.0.1:{free_port()}" for _ in range(2)]
    async with Router(listen=[first], connect=[second]) as one, Router(listen=[second], connect=[first]) as two:
        yield {"robot": one, "gateway": two}


@pytest.mark.parametrize("sides", [["gateway"], ["robot"], ["robot", "gateway"]], ids=" and ".join)
async def test_a_kept_topic_survives_an_outage(
    sides: list[str], routers: dict[str, Router], domain: int, peer: Peer
) -> None:
    """With one side's router away, or both, for longer than a lease, a headset gets every message of a kept topic, in
    order and once, and the node on the robot is the same one."""
    settings = Settings(mesh=MeshSettings(connect=[routers["robot"].endpoint]), robot=RobotSettings(id=7, rules=RULES))
    async with AsyncExitStack() as stack:
        robot = await stack.enter_async_context(open_robot(settings, domain_id=domain))
        mesh = await stack.enter_async_context(await Mesh.open(MeshSettings(connect=[routers["gateway"].endpoint])))
        gateway = Gateway(mesh, GatewaySettings(port=0))
        stack.push_async_callback(gateway.close)
        await gateway.start()
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        publisher = await peer.publisher(String, "/log", 1000)
        topic = await headset.subscribe("/log", "std_msgs/String", agents=[7], buffer_size=2000)
        heard: list[int] = []

        async def listen() -> None:
            async for message in topic:
                heard.append(int(message.data[8:].rstrip(b"\0")))

        async def talk() -> None:
            start = time.monotonic()
            for number in itertools.count():
                publisher.publish(String(data=str(number)))
                await asyncio.sleep(max(0.0, start + number / HZ - time.monotonic()))

        tasks = [asyncio.create_task(listen()), asyncio.create_task(talk())]
        try:
            await until(lambda: heard)
            node = robot.nodes.get(NodeType.SUBSCRIBER, "nd__log")
            await asyncio.gather(*(routers[side].stop(signal.SIGKILL) for side in sides))
            await asyncio.sleep(AWAY_S)
            await asyncio.gather(*(routers[side].start() for side in sides))
            enough = heard[-1] + int((AWAY_S + 1) * HZ)
            await until(lambda: heard[-1] > enough)
            assert heard == list(range(heard[0], heard[-1] + 1))
            assert robot.nodes.get(NodeType.SUBSCRIBER, "nd__log") is node
        finally:
            for task in tasks:
                task.cancel()


async def test_a_registrant_that_left_lingers_on_kept_topics_only(session: RosSession) -> None:
    """An agent that is not seen any more stays registered for a while where messages are kept; leaving by itself, or
    the end of that while, takes it off."""
    kept: dict[str, int | None] = {}

    def keep(node: str, frames: int | None) -> bool:
        kept[node] = frames
        return frames is not None

    robot = Robot(session, 7, lambda node, frame: None, rules=Rules(RobotSettings(rules=RULES)), keep_stream=keep)
    nodes = InterfaceNodes(robot)
    try:
        for topic in ("/log", "/pose"):
            await nodes.add(adding(topic))
        assert kept == {"nd__log": 2000, "nd__pose": None}
        log = nodes.get(NodeType.SUBSCRIBER, "nd__log")
        assert log is not None
        (registrant,) = log.registrants
        nodes.forget(registrant)
        assert nodes.get(NodeType.SUBSCRIBER, "nd__pose") is None
        assert log.registrants == {registrant}
        await nodes.add(adding("/log"))
        log.linger_s = 0.05
        nodes.forget(Registrant(*registrant))
        await until(lambda: nodes.get(NodeType.SUBSCRIBER, "nd__log") is None)
        assert kept["nd__log"] is None
    finally:
        nodes.close()
