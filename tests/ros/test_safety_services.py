"""While the emergency stop holds, nothing acts: services and goals are refused as commands are."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.serialization import serialize_message
from std_srvs.srv import SetBool, Trigger

from bridge.ros import services
from bridge.ros.interface import Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.protocol.messages import CallFailure, Metadata, NodeType, decode_data, node_name
from macs_zenoh.protocol.reading import Message
from tests.ros.driven import hear
from tests.support.ros_peer import Peer, adding, drive
from tests.support.waiting import get, until

RULES = [
    TopicRule(match="/state", allow_while_stopped=True),
    TopicRule(match="/lamp", allow_while_stopped=True),
    TopicRule(match="/cmd_vel", deadman_message={"linear": {"z": -1}}),
]
KINDS = {"/motors": SetBool, "/state": Trigger}


@pytest.fixture
async def site(session: RosSession, peer: Peer) -> AsyncIterator[SimpleNamespace]:
    """A robot with a service that moves it and one that does not, and what either was asked."""
    answers: asyncio.Queue[tuple[Metadata, bytes]] = asyncio.Queue()
    asked: list[str] = []
    robot = Robot(
        session,
        7,
        lambda node, frame: None,
        send=lambda to, metadata, data: answers.put_nowait((metadata, data)),
        rules=Rules(RobotSettings(rules=RULES)),
    )
    nodes = InterfaceNodes(robot)
    await nodes.open_stop("/emergency_stop")
    for name, kind in KINDS.items():
        await serve(peer, kind, name, asked, session)
    yield SimpleNamespace(nodes=nodes, answers=answers, asked=asked, peer=peer)
    nodes.close()


async def serve(peer: Peer, kind: Any, name: str, asked: list[str], robot: RosSession) -> None:
    def answer(_request: Any, response: Any) -> Any:
        asked.append(name)
        response.success = True
        return response

    await peer.service(kind, name, answer, robot)


def call(name: str, number: int) -> Message:
    kind = KINDS[name]
    cdr = bytes(serialize_message(kind.Request()))
    metadata = Metadata(
        2, 5, number, CallFailure.manager, NodeType.CLIENT, node_name(name), f"std_srvs/{kind.__name__}"
    )
    return Message("unity", 5, metadata, cdr)


async def register(site: SimpleNamespace, name: str) -> None:
    await site.nodes.add(adding(name, f"std_srvs/{KINDS[name].__name__}", node_type=NodeType.CLIENT))


async def answer_to(site: SimpleNamespace, number: int) -> tuple[Metadata, bytes]:
    while True:
        metadata, data = await get(site.answers)
        if metadata.request_id == number:
            return metadata, data


async def test_a_service_that_acts_is_refused(site: SimpleNamespace) -> None:
    """A call is refused while the stop holds, with the reason; one that a rule allows, and one after it, pass."""
    for name in KINDS:
        await register(site, name)
    site.nodes.stop.press("operator/5")
    site.nodes.deliver(call("/motors", 1))
    metadata, data = await answer_to(site, 1)
    assert metadata.message_manager == CallFailure.manager
    failure = decode_data(CallFailure, data)
    assert (failure.kind, failure.reason) == ("refused", "the emergency stop by operator/5 holds")
    site.nodes.deliver(call("/state", 2))
    await answer_to(site, 2)
    assert site.asked == ["/state"]
    site.nodes.stop.release("operator/5")
    site.nodes.deliver(call("/motors", 3))
    await answer_to(site, 3)
    assert site.asked == ["/state", "/motors"]
    assert site.nodes.drops["call_refused"] == 1


async def test_calls_that_wait_for_their_turn_are_refused(site: SimpleNamespace) -> None:
    """More calls than ROS is given at once: those that have not gone out when the stop is pressed never do."""
    await register(site, "/motors")
    count = 3 * services.BURST
    for number in range(count):
        site.nodes.deliver(call("/motors", number))
    site.nodes.stop.press("unity/6")
    kinds = [(await get(site.answers))[0].message_manager for _ in range(count)]
    assert kinds.count(CallFailure.manager) >= count - services.BURST
    before = len(site.asked)
    await asyncio.sleep(0.3)
    assert len(site.asked) == before <= services.BURST


async def test_a_topic_may_be_allowed_as_well(site: SimpleNamespace) -> None:
    """A lamp that shall go on working does, a drive does not."""
    lamp, wheels = await hear(site.peer, "/lamp"), await hear(site.peer, "/cmd_vel")
    node = site.nodes.robot.session.node
    await until(lambda: node.count_subscribers("/lamp") and node.count_subscribers("/cmd_vel"))
    for topic in ("/lamp", "/cmd_vel"):
        await site.nodes.add(adding(topic, "geometry_msgs/Twist", node_type=NodeType.PUBLISHER))
    site.nodes.stop.press("unity/6")
    for topic in ("/lamp", "/cmd_vel"):
        site.nodes.deliver(drive(0.5, topic=topic))
    await until(lambda: lamp.values and wheels.values)
    await asyncio.sleep(0.2)
    assert [value for _, value in lamp.values] == [0.5]
    assert [value for _, value in wheels.values] == [-1.0]


async def test_what_waited_while_the_robot_was_stopped_is_not_done(site: SimpleNamespace) -> None:
    """A stop that is released at once: neither a command nor a call that came before its registration, nor a call
    that waits for its turn, is carried out after it."""
    wheels, lamp = await hear(site.peer, "/cmd_vel"), await hear(site.peer, "/lamp")
    await register(site, "/motors")
    count = 3 * services.BURST
    for number in range(1, count + 1):
        site.nodes.deliver(call("/motors", number))
    for topic in ("/cmd_vel", "/lamp"):
        site.nodes.deliver(drive(0.5, topic=topic))
    site.nodes.stop.press("unity/6")
    site.nodes.stop.release("unity/6")
    node = site.nodes.robot.session.node
    await until(lambda: node.count_subscribers("/lamp") and node.count_subscribers("/cmd_vel"))
    for topic in ("/cmd_vel", "/lamp"):
        await site.nodes.add(adding(topic, "geometry_msgs/Twist", node_type=NodeType.PUBLISHER))
    answers: list[str] = []
    while len(answers) < count:
        metadata, _ = await get(site.answers)
        answers += [metadata.message_manager] if metadata.request_id else []  # commands have none
    assert answers.count(CallFailure.manager) >= count - services.BURST
    await until(lambda: lamp.values)
    site.nodes.deliver(drive(0.25))
    await until(lambda: wheels.values)
    assert [value for _, value in wheels.values] == [0.25]
    assert site.nodes.drops["stopped"] == 1
