"""Settings per topic on real topics: QoS and rate."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator

import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_msgs.msg import String

from bridge.ros.interface import Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.ros.subscriber import RateLimit
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.protocol.messages import NodeType
from macs_zenoh.protocol.wire import parse_frame
from tests.support.ros_peer import Peer, adding, command
from tests.support.waiting import get, until


def test_the_latest_of_those_that_come_too_soon_is_sent() -> None:
    """One message per period: the first at once, then the latest when its time has come, and no more."""
    rate = RateLimit(10)
    assert rate.offer(b"1", 0.0) is None
    assert rate.offer(b"2", 0.02) == pytest.approx(0.1)
    assert rate.waiting
    assert rate.offer(b"3", 0.05) == pytest.approx(0.1)
    assert rate.take(0.101) == b"3"
    assert rate.take(0.101) is None
    assert rate.offer(b"4", 0.15) == pytest.approx(0.2)
    assert rate.take(0.2) == b"4"
    assert rate.offer(b"5", 5.0) is None
    assert rate.offer(b"6", 5.01) is not None


RULES = [
    TopicRule(match="/fast", max_hz=10),
    TopicRule(match="/loose", reliability="best_effort", durability="volatile", depth=7),
    TopicRule(match="/kept", durability="transient_local"),
]


@pytest.fixture
async def frames() -> asyncio.Queue[bytes]:
    return asyncio.Queue()


@pytest.fixture
async def nodes(session: RosSession, frames: asyncio.Queue[bytes]) -> AsyncIterator[InterfaceNodes]:
    loop = asyncio.get_running_loop()

    def put(node: str, frame: bytes) -> None:
        loop.call_soon_threadsafe(frames.put_nowait, frame)

    nodes = InterfaceNodes(Robot(session, 7, put, rules=Rules(RobotSettings(rules=RULES))))
    yield nodes
    nodes.close()


async def test_a_limited_topic_sends_the_latest(
    nodes: InterfaceNodes, frames: asyncio.Queue[bytes], peer: Peer
) -> None:
    """Of 200 Hz for a second, about 10 messages are sent, and the last one is among them."""
    await nodes.add(adding("/fast"))
    publisher = await peer.publisher(String, "/fast", matched=1)
    began = time.monotonic()
    for number in range(200):
        publisher.publish(String(data=str(number)))
        await asyncio.sleep(0.005)
    sent: list[int] = []
    while 199 not in sent:
        frame = parse_frame(await get(frames))
        sent.append(int(deserialize_message(bytes(frame.body), String).data))
    assert sent == sorted(sent)
    assert 8 <= len(sent) <= 2 + 10 * (time.monotonic() - began)  # a busy machine needs longer than a second for 200


async def test_what_waits_for_its_time_goes_straight_into_the_mesh(session: RosSession, peer: Peer) -> None:
    """A limited topic's message that had to wait is put where its time ends, on the loop: not by way of ROS's thread,
    which may be busy."""
    putting: list[int] = []
    put = lambda node, frame: putting.append(threading.get_ident())  # noqa: E731
    nodes = InterfaceNodes(Robot(session, 7, put, rules=Rules(RobotSettings(rules=RULES))))
    await nodes.add(adding("/fast"))
    publisher = await peer.publisher(String, "/fast", matched=1)
    while threading.get_ident() not in putting:
        publisher.publish(String(data="x"))
        await asyncio.sleep(0.005)
    nodes.close()


async def test_settings_replace_the_qos_of_a_topic(nodes: InterfaceNodes, peer: Peer) -> None:
    """A subscription is as the settings say, not as its publishers are."""
    await peer.publisher(String, "/loose", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    node = nodes.robot.session.node
    await until(lambda: node.count_publishers("/loose") == 1)
    await nodes.add(adding("/loose"))
    (endpoint,) = node.get_subscriptions_info_by_topic("/loose")
    assert endpoint.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
    assert endpoint.qos_profile.durability == DurabilityPolicy.VOLATILE


async def test_settings_can_make_a_publisher_latch(nodes: InterfaceNodes, peer: Peer) -> None:
    """What a headset publishes is kept for ROS nodes that come later, without the headset asking for it."""
    await nodes.add(adding("/kept", node_type=NodeType.PUBLISHER, buffer_size=1))
    nodes.deliver(command("/kept", String(data="kept")))
    late = await peer.subscription(String, "/kept", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    assert (await get(late)).data == "kept"
