"""Mirrors on the wire: what robots that mirror each other send, and what becomes of a latched map."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String

from bridge.ros.agent import RobotAgent
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings
from bridge.settings.mirror import MirrorRule
from macs_zenoh.config import MeshSettings
from tests.support.links import Link, counted
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, get, until

pytestmark = pytest.mark.timeout(300)

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
HZ = 50
POSE_BYTES = 4000


async def robot(stack: AsyncExitStack, router: str, number: int, domain: int, *rules: MirrorRule) -> RobotAgent:
    settings = Settings(
        mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=number, group=3, mirror=list(rules))
    )
    return await stack.enter_async_context(open_robot(settings, domain_id=domain))


def peer(stack: AsyncExitStack, domain: int) -> Peer:
    made = Peer(domain)
    stack.callback(made.session.close)
    return made


@pytest.mark.parametrize("seconds", [3, pytest.param(60, marks=pytest.mark.soak)])
async def test_each_robot_sends_one_copy(router: str, domain: int, seconds: int) -> None:
    """Three robots with each other's poses at 50 Hz, of which two nodes on each robot have each: every pose comes once
    to each node, in order, goes up once, and comes down once from each of the others."""
    domains = [domain, domain + 60, domain + 120]
    rule = MirrorRule(source="group/3", topics=["/pose"], name="/robot{robot}{topic}")
    async with AsyncExitStack() as stack:
        links: list[Link] = [await stack.enter_async_context(counted(router)) for _ in domains]
        peers = [peer(stack, each) for each in domains]
        for number, (link, each) in enumerate(zip(links, domains, strict=True), start=1):
            await robot(stack, link.endpoint, number, each, rule)
        publishers = [await each.publisher(String, "/pose") for each in peers]
        pairs = [(here, there) for here in range(3) for there in range(3) if here != there]
        heard = [
            [await peers[here].subscription(String, f"/robot{there + 1}/pose") for _ in range(2)]
            for here, there in pairs
        ]

        def all_heard() -> bool:
            for publisher in publishers:
                publisher.publish(String(data="begin"))
            return all(not queue.empty() for both in heard for queue in both)

        await until(all_heard, PATIENCE_S, every_s=0.05)

        def now(link: Link) -> tuple[int, int]:
            return link.up_bytes, link.down_bytes

        before = list(map(now, links))
        count = HZ * seconds
        for number in range(count):
            for publisher in publishers:
                publisher.publish(String(data=f"{number} ".ljust(POSE_BYTES, "x")))
            await asyncio.sleep(1 / HZ)
        said: list[list[str]] = [[] for both in heard for _ in both]

        def all_have_ended() -> bool:
            for publisher in publishers:
                publisher.publish(String(data="end"))
            for words, queue in zip(said, (queue for both in heard for queue in both), strict=True):
                while not queue.empty():
                    words.append(queue.get_nowait().data.split()[0])
            return all("end" in words for words in said)

        await until(all_have_ended, PATIENCE_S, every_s=0.05)
        for words in said:
            numbers = [int(word) for word in words if word.isdigit()]
            assert numbers == sorted(set(numbers))  # a busy machine may lose some
            assert len(numbers) > count / 2
        copies = [
            tuple((after - at) / (count * POSE_BYTES) for after, at in zip(now(link), was, strict=True))
            for link, was in zip(links, before, strict=True)
        ]
        for up, down in copies:
            assert 0.5 < up < 1.5, copies
            assert 1 < down < 2.7, copies


async def test_a_map_reaches_a_robot_that_joins_later(router: str, domain: int) -> None:
    """What robot 1 latched before robot 2 was there comes into robot 2's graph, and to nodes that come later still."""
    there, here = domain, domain + 100
    async with AsyncExitStack() as stack:
        other = peer(stack, there)
        held = await other.publisher(String, "/map", LATCHED)
        held.publish(String(data="hall"))
        await robot(stack, router, 1, there)
        first = await robot(stack, router, 3, domain + 50, MirrorRule(source="ros/1", topics=["/map"]))
        early = peer(stack, domain + 50)
        assert (await get(await early.subscription(String, "/robot1/map", LATCHED))).data == "hall"
        await robot(stack, router, 2, here, MirrorRule(source="ros/1", topics=["/map"]))
        own = peer(stack, here)
        for _ in range(2):
            maps = await own.subscription(String, "/robot1/map", LATCHED)
            assert (await get(maps)).data == "hall"
        assert first.agent.id == 3
