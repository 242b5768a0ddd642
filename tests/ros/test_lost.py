"""What ROS lost before it could be taken is counted, and nothing else is."""

from __future__ import annotations

import asyncio
import itertools
import re
import threading
from collections.abc import AsyncIterator
from typing import Any

import pytest
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from bridge.ros.gaps import Gaps
from bridge.ros.interface import Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.session import RosSession
from tests.support.ros_peer import Peer, adding
from tests.support.waiting import until

DEPTH = 5
QOS = {
    "reliable": QoSProfile(depth=1000),
    "best effort": QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT),
}


class Uplink:
    """What a robot streams; while it is shut, whoever streams has to wait. ``seen``: the numbers in the messages."""

    def __init__(self) -> None:
        self.seen: list[int] = []
        self.open = threading.Event()
        self.open.set()

    def publish(self, node: str, frame: bytes) -> None:
        number = re.search(rb"number (\d+)\0", frame)
        assert number is not None
        self.seen.append(int(number[1]))
        assert self.open.wait(10)

    @property
    def missing(self) -> int:
        """How many between the first and the last were never streamed."""
        return self.seen[-1] - self.seen[0] + 1 - len(self.seen)


@pytest.fixture
async def uplink() -> Uplink:
    return Uplink()


@pytest.fixture
async def nodes(session: RosSession, uplink: Uplink) -> AsyncIterator[InterfaceNodes]:
    """A headset has subscribed /t with a short buffer."""
    nodes = InterfaceNodes(Robot(session, 7, uplink.publish))
    await nodes.add(adding("/t", buffer_size=DEPTH))
    yield nodes
    uplink.open.set()
    nodes.close()


def test_gaps_are_counted_while_one_publisher_numbers() -> None:
    """Only numbers of one and the same publisher say what is missing; a smaller number is a new beginning."""
    gaps = Gaps()
    assert not gaps.take(5)
    assert not gaps.take(9), "nobody has said that there is one publisher"
    gaps.publishers(1)
    assert not gaps.take(7)
    assert gaps.counting
    assert not gaps.take(8)
    assert gaps.take(11)
    assert not gaps.take(13), "told once until somebody asks"
    assert gaps.missing() == 3
    assert gaps.missing() == 0
    assert not gaps.take(1)
    assert gaps.take(3)
    gaps.publishers(2)
    assert not gaps.take(100)
    assert gaps.missing() == 0
    gaps.publishers(1)
    assert not gaps.take(None)
    assert not gaps.take(50)
    assert not gaps.take(51)


@pytest.mark.parametrize("kind", QOS)
async def test_what_a_full_buffer_loses_is_counted(
    nodes: InterfaceNodes, uplink: Uplink, peer: Peer, kind: str
) -> None:
    """Of 50 messages while nothing is taken the last few arrive, and all others are in the count."""
    publisher = await peer.publisher(String, "/t", QOS[kind], matched=1)
    numbers = itertools.count()

    def send() -> None:
        publisher.publish(String(data=f"number {next(numbers)}"))

    await until(lambda: uplink.seen or send())
    uplink.open.clear()
    seen = len(uplink.seen)
    await until(lambda: len(uplink.seen) > seen or send())
    for _ in range(50):
        send()
    await asyncio.to_thread(publisher.wait_for_all_acked, Duration(seconds=5))
    uplink.open.set()
    await until(lambda: 0 < nodes.drops["lost_in_ros"] == uplink.missing)
    assert nodes.drops.keys() == {"lost_in_ros"}
    if kind == "reliable":
        assert uplink.missing >= 50 - DEPTH


async def test_nothing_is_counted_that_was_not_lost(nodes: InterfaceNodes, uplink: Uplink, peer: Peer) -> None:
    """Publishers that come, go and publish at the same time have numbers of their own, which are no losses."""
    first = await peer.publisher(String, "/t", 100, matched=1)
    numbers = itertools.count()

    async def arrives(*publishers: Any) -> None:
        for publisher in publishers:
            number = next(numbers)
            publisher.publish(String(data=f"number {number}"))
            await until(lambda number=number: uplink.seen and uplink.seen[-1] == number)

    await until(lambda: uplink.seen or first.publish(String(data=f"number {next(numbers)}")))
    for _ in range(20):
        await arrives(first)
    second = await peer.publisher(String, "/t", 100, matched=1)
    for _ in range(10):
        await arrives(second, first)
    await peer.session.run(lambda: peer.session.node.destroy_publisher(first))
    for _ in range(10):
        await arrives(second)
    await asyncio.sleep(2 * Gaps.SETTLE_S)
    assert not nodes.drops
