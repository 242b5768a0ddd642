"""A stop message that the middleware does not take at once."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any

import pytest
from geometry_msgs.msg import Twist

from bridge.ros.interface import Registrant, Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.ros.side import CutOff, Publisher
from bridge.ros.topics import STOP_TIMES, PublisherNode
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.protocol.messages import NodeType
from tests.support.ros_peer import Peer, adding, drive, reaches
from tests.support.waiting import get, until

RULE = TopicRule(match="/cmd_vel", deadman_message={"linear": {"z": -1}})


@pytest.fixture
async def nodes(session: RosSession) -> AsyncIterator[InterfaceNodes]:
    nodes = InterfaceNodes(Robot(session, 7, lambda node, frame: None, rules=Rules(RobotSettings(rules=[RULE]))))
    yield nodes
    nodes.close()


@dataclass
class Driven:
    """Interface nodes that drive a robot for agents 5 and 6, and what the robot hears."""

    nodes: InterfaceNodes
    publisher: Publisher
    received: asyncio.Queue[Any]


@pytest.fixture
async def driven(nodes: InterfaceNodes, peer: Peer) -> Driven:
    received = await peer.subscription(Twist, "/cmd_vel")
    await peer.sees("/cmd_vel", subscriptions=1)
    for registrant in (5, 6):
        await nodes.add(adding("/cmd_vel", "geometry_msgs/Twist", node_type=NodeType.PUBLISHER, registrant=registrant))
    await reaches(nodes, "/cmd_vel")
    node = nodes.on_topic(NodeType.PUBLISHER, "/cmd_vel")
    assert isinstance(node, PublisherNode)
    assert node._publisher is not None
    nodes.deliver(drive(0.5))
    assert (await get(received)).linear.x == 0.5
    return Driven(nodes, node._publisher, received)


@pytest.mark.parametrize(("error", "counted"), [(RuntimeError("no room"), 3), (CutOff("no way"), 1)])
async def test_it_is_published_until_it_is_taken(
    driven: Driven, monkeypatch: pytest.MonkeyPatch, error: Exception, counted: int
) -> None:
    """The driver leaves in a moment in which ROS takes nothing: the robot stops when it takes something again. Each
    refusal counts, and a way that is lost as one."""
    nodes, received = driven.nodes, driven.received
    publish, refused = driven.publisher.publish, []

    def refuse(cdr: bytes) -> None:
        if len(refused) < 3:
            refused.append(cdr)
            raise error
        publish(cdr)

    monkeypatch.setattr(driven.publisher, "publish", refuse)
    nodes.forget(Registrant(2, 5))
    stop = await get(received)
    assert (stop.linear.x, stop.linear.z) == (0.0, -1.0)
    assert len(refused) == 3
    assert nodes.drops["failed"] == counted

    nodes.deliver(drive(0.25, sender=6))
    assert (await get(received)).linear.x == 0.25
    refused.clear()
    nodes.forget(Registrant(2, 6))  # and its publisher with it
    stop = await get(received)
    assert (stop.linear.x, stop.linear.z, len(refused)) == (0.0, -1.0, 3)
    assert nodes.drops["failed"] == 2 * counted


async def test_one_that_is_never_taken_is_an_error(
    driven: Driven, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """After so many refusals it is given up, and the log says that the robot was not stopped."""

    def refuse(cdr: bytes) -> None:
        raise RuntimeError("no room")

    monkeypatch.setattr(driven.publisher, "publish", refuse)
    driven.nodes.forget(Registrant(2, 5))
    await until(lambda: [record for record in caplog.records if record.levelno == logging.ERROR])
    assert "/cmd_vel: unity/5 left; the stop message could not be published" in caplog.messages
    assert driven.nodes.drops["failed"] == STOP_TIMES
    assert driven.received.empty()
