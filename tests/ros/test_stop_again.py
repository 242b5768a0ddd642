"""A stop message that the middleware does not take at once."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
from geometry_msgs.msg import Twist

from bridge.ros.interface import Registrant, Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.ros.topics import PublisherNode
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.protocol.messages import NodeType
from tests.support.ros_peer import Peer, adding, drive, reaches
from tests.support.waiting import get

RULE = TopicRule(match="/cmd_vel", deadman_message={"linear": {"z": -1}})


@pytest.fixture
async def nodes(session: RosSession) -> AsyncIterator[InterfaceNodes]:
    nodes = InterfaceNodes(Robot(session, 7, lambda node, frame: None, rules=Rules(RobotSettings(rules=[RULE]))))
    yield nodes
    nodes.close()


async def test_it_is_published_until_it_is_taken(
    nodes: InterfaceNodes, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The driver leaves in a moment in which ROS takes nothing: the robot stops when it takes something again."""
    received = await peer.subscription(Twist, "/cmd_vel")
    await peer.sees("/cmd_vel", subscriptions=1)
    for registrant in (5, 6):
        await nodes.add(adding("/cmd_vel", "geometry_msgs/Twist", node_type=NodeType.PUBLISHER, registrant=registrant))
    await reaches(nodes, "/cmd_vel")
    node = nodes.on_topic(NodeType.PUBLISHER, "/cmd_vel")
    assert isinstance(node, PublisherNode)
    publisher = node._publisher
    assert publisher is not None
    publish, refused = publisher.publish, []

    def refuse(cdr: bytes) -> None:
        if len(refused) < 3:
            refused.append(cdr)
            raise RuntimeError("no room")
        publish(cdr)

    nodes.deliver(drive(0.5))
    assert (await get(received)).linear.x == 0.5
    monkeypatch.setattr(publisher, "publish", refuse)
    nodes.forget(Registrant(2, 5))
    stop = await get(received)
    assert (stop.linear.x, stop.linear.z) == (0.0, -1.0)
    assert len(refused) == 3
    assert nodes.drops["failed"] == 1

    nodes.deliver(drive(0.25, sender=6))
    assert (await get(received)).linear.x == 0.25
    refused.clear()
    nodes.forget(Registrant(2, 6))  # and its publisher with it
    stop = await get(received)
    assert (stop.linear.x, stop.linear.z, len(refused)) == (0.0, -1.0, 3)
