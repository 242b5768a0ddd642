"""What happens while the emergency stop changes: a release on its way, a button's press, a node that fails."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Bool, String

from bridge.ros.agent import RobotAgent
from bridge.ros.interface import Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.ros.shared_stop import A_NODE, AGENTS
from bridge.ros.stop import STATES, StopNode
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.agent import Agent
from macs_zenoh.mesh import now_s
from macs_zenoh.protocol.messages import OPERATOR, ROS, UNITY, Metadata, NodeType
from macs_zenoh.protocol.routing import unicast_key
from macs_zenoh.protocol.wire import encode_frame, encode_message
from tests.support.ros_peer import ROBOT, Peer, adding, reaches
from tests.support.waiting import get, until

TOPIC = "/emergency_stop"
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RULES = [TopicRule(match=name, deadman_s=60, deadman_message={}) for name in ("/first", "/second")]


@pytest.fixture
async def nodes(session: RosSession) -> AsyncIterator[InterfaceNodes]:
    nodes = InterfaceNodes(Robot(session, 7, lambda node, frame: None, rules=Rules(RobotSettings(rules=RULES))))
    await nodes.open_stop(TOPIC)
    yield nodes
    nodes.close()


@pytest.fixture
async def stop(nodes: InterfaceNodes) -> StopNode:
    assert nodes.stop is not None
    return nodes.stop


class Publisher:
    """The stop's publisher, with something that happens while it publishes."""

    def __init__(self, stop: StopNode, meanwhile: Any) -> None:
        self._publisher, self._meanwhile = stop._publisher, meanwhile

    def publish(self, state: bytes) -> None:
        self._publisher.publish(state)
        self._meanwhile()


def fails(*_: object) -> None:
    raise RuntimeError("this one fails")


@pytest.mark.parametrize(("sender", "age_s"), [((UNITY, 5), 0.5), ((UNITY, 5), 0.0), ((OPERATOR, 1), 0.0)])
async def test_a_release_on_its_way_does_not_follow_a_stop(
    robot: RobotAgent, headset: Agent, sender: tuple[int, int], age_s: float
) -> None:
    """Who asks for a stop overtakes the release that he put before: also while the robot is being stopped, and also
    one that comes then, whoever sent it: he could not know of the stop."""
    stop, guard = robot.nodes.stop, robot._guard
    assert stop is not None
    assert guard is not None
    about = Metadata(*sender, 0, "", NodeType.PUBLISHER, stop.key.node_name, "std_msgs/Bool")
    release = encode_frame(ROS, (ROBOT,), message=encode_message(about.encode(), STATES[False]))
    come: list[threading.Thread] = []
    on_stop = stop._on_stop

    def meanwhile(by: str) -> None:
        arguments = (unicast_key(ROS, ROBOT, *sender), release, age_s, now_s())
        come.append(threading.Thread(target=guard.first, args=arguments))
        come[0].start()
        time.sleep(0.2)  # it is judged now, and waits for what is done here
        on_stop(by)

    stop._on_stop = meanwhile
    await headset.call("ros", ROBOT, "stop", b"true")
    await asyncio.to_thread(come[0].join)
    assert robot.nodes.robot.stop.stopped
    await headset.call("ros", ROBOT, "stop", b"false")
    assert not robot.nodes.robot.stop.stopped


async def test_a_press_during_our_own_release_counts(nodes: InterfaceNodes, stop: StopNode, peer: Peer) -> None:
    """A button that is pressed while the agent publishes that the robot may go on stops it again."""
    button = await peer.publisher(Bool, TOPIC, LATCHED, matched=1)
    stop.press("unity/5")
    stop._publisher = Publisher(stop, lambda: button.publish(Bool(data=True)))
    stop.release("unity/5")
    stop._publisher = stop._publisher._publisher
    await until(lambda: nodes.robot.stop.stopped)
    assert nodes.robot.stop.pressed == [A_NODE]


BUTTONS = {
    "latched": LATCHED,
    "as nodes do by default": QoSProfile(depth=10),
    "best effort": QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT),
}


@pytest.mark.parametrize("button", BUTTONS)
async def test_a_button_stops_whatever_it_offers(
    button: str, nodes: InterfaceNodes, stop: StopNode, peer: Peer
) -> None:
    """Each press counts, once: after a release nothing of it comes back, and the next one stops again."""
    publisher = await peer.publisher(Bool, TOPIC, BUTTONS[button], matched=1)
    for times in (1, 2, 3):
        while nodes.robot.stop.times < times:  # one way may lose it
            publisher.publish(Bool(data=True))
            with suppress(AssertionError):
                await until(lambda times=times: nodes.robot.stop.times == times, 2)
        assert nodes.robot.stop.pressed == [A_NODE]
        stop.release("operator/5")
        await asyncio.sleep(0.3)
        assert not nodes.robot.stop.stopped


async def test_a_node_that_fails_stops_no_others_stop(nodes: InterfaceNodes, stop: StopNode, peer: Peer) -> None:
    """The stop message of each other node is published, and other nodes and agents of the graph hear of the stop."""
    for topic in ("/first", "/second"):
        await nodes.add(adding(topic, "geometry_msgs/Twist", node_type=NodeType.PUBLISHER))
    second = await peer.subscription(Twist, "/second")
    told, agents = await peer.subscription(Bool, TOPIC), await peer.subscription(String, TOPIC + AGENTS)
    for topic in ("/second", TOPIC, TOPIC + AGENTS):
        await until(lambda topic=topic: peer.session.node.count_publishers(topic) >= 1)
    await until(lambda: stop._publisher._made.get_subscription_count() >= 2)
    await reaches(nodes, "/second")
    first = nodes.get(NodeType.PUBLISHER, "nd__first")
    assert first is not None
    first.emergency_stop = fails  # type: ignore[method-assign]
    stop.press("unity/5")
    assert await get(second) == Twist()
    assert (await get(told)).data
    while '"unity/5"' not in (await get(agents)).data:
        pass


@pytest.mark.parametrize("part", ["_on_stop", "_publisher"])
async def test_other_agents_hear_of_a_stop_that_fails(
    part: str, nodes: InterfaceNodes, stop: StopNode, peer: Peer
) -> None:
    """Whatever fails here, it holds for the graph."""
    agents = await peer.subscription(String, TOPIC + AGENTS)
    await until(lambda: peer.session.node.count_publishers(TOPIC + AGENTS) == 1)
    await until(lambda: stop._shared._publisher._made.get_subscription_count() >= 2)  # type: ignore[union-attr]
    whole = getattr(stop, part)
    setattr(stop, part, fails if part == "_on_stop" else Publisher(stop, fails))
    with pytest.raises(RuntimeError, match="this one fails"):
        stop.press("unity/5")
    setattr(stop, part, whole)
    assert nodes.robot.stop.stopped
    while '"unity/5"' not in (await get(agents)).data:
        pass
