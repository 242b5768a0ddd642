"""A latched topic comes to each subscription of an agent, whenever it is made: a real robot agent and ROS nodes."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

import macs_zenoh
from bridge.ros.agent import RobotAgent
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, until

ROBOT = 7
LATCHED = QoSProfile(depth=2, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
async def robot(router: str, domain: int) -> AsyncIterator[RobotAgent]:
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=ROBOT, group=3))
    async with open_robot(settings, domain_id=domain) as robot:
        yield robot


@pytest.fixture
async def agent(router: str, robot: RobotAgent) -> AsyncIterator[Agent]:
    async with macs_zenoh.join("unity", id=5, connect=[router]) as agent:
        await until(lambda: (1, ROBOT) in agent.directory, PATIENCE_S)
        yield agent


async def publish(peer: Peer, publisher: object, *texts: str) -> None:
    for text in texts:
        await peer.session.run(lambda text=text: publisher.publish(String(data=text)))  # type: ignore[attr-defined, misc]


async def heard(subscription: macs_zenoh.TopicSubscription) -> str:
    return str((await asyncio.wait_for(subscription.receive(), PATIENCE_S)).value["data"])


async def test_each_subscription_gets_what_is_held(agent: Agent, peer: Peer) -> None:
    """The first from the robot, later ones what the first has had and no more than they take; then all get the same,
    each message once. One that comes when all others have gone asks the robot again."""
    publisher = await peer.publisher(String, "/map", LATCHED)
    await publish(peer, publisher, "a", "b")
    first = await agent.subscribe("/map", robot=ROBOT, type="std_msgs/String")
    assert [await heard(first) for _ in range(2)] == ["a", "b"]
    second = await agent.subscribe("/map", robot=ROBOT)
    shallow = await agent.subscribe("/map", group=3, depth=1)
    assert [await heard(second) for _ in range(2)] == ["a", "b"]
    assert await heard(shallow) == "b"
    await publish(peer, publisher, "c")
    for each in (first, second, shallow):
        assert await heard(each) == "c"
        assert each.dropped == 0
        each.close()
    again = await agent.subscribe("/map", robot=ROBOT)
    assert [await heard(again) for _ in range(2)] == ["b", "c"]


async def test_what_is_not_held_is_not_given(agent: Agent, peer: Peer) -> None:
    """A later subscription of another topic begins with what is published after it: nothing old seems new."""
    publisher = await peer.publisher(String, "/chatter")
    first = await agent.subscribe("/chatter", robot=ROBOT, type="std_msgs/String")
    publishing = asyncio.ensure_future(_until_cancelled(peer, publisher))
    try:
        assert await heard(first) == "before"
    finally:
        publishing.cancel()
        await asyncio.gather(publishing, return_exceptions=True)
    await publish(peer, publisher, "the last")  # DDS keeps the order
    while await heard(first) != "the last":
        pass
    second = await agent.subscribe("/chatter", robot=ROBOT)
    await publish(peer, publisher, "after")
    assert await heard(second) == "after"


async def _until_cancelled(peer: Peer, publisher: object) -> None:
    while True:
        await publish(peer, publisher, "before")
        await asyncio.sleep(0.02)
