"""A wstring that is no Unicode, which rclpy refuses with an error of its own: who waits is told, and nothing stays."""

from __future__ import annotations

import asyncio
import importlib
import struct
from collections.abc import AsyncIterator
from typing import Any

import pytest
from rclpy.action import ActionServer

from bridge.ros.interface import Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.session import RosSession
from macs_zenoh.protocol.messages import ActionVerb, CallFailure, Metadata, NodeType, decode_data, node_name
from macs_zenoh.protocol.reading import Message
from tests.support.ros_peer import Peer, adding, known_action
from tests.support.waiting import get, until

pytestmark = pytest.mark.timeout(600)  # the first of them compiles its messages, on a busy machine for minutes

HALF = b"\x00\x01\x00\x00" + struct.pack("<II", 1, 0xD800)
"""One half of a pair of UTF-16."""

Sent = asyncio.Queue[Any]


@pytest.fixture
async def sent() -> Sent:
    """What the robot sends to single headsets."""
    return asyncio.Queue()


@pytest.fixture
async def nodes(session: RosSession, sent: Sent, kinds: Any) -> AsyncIterator[InterfaceNodes]:
    nodes = InterfaceNodes(Robot(session, 7, lambda node, frame: None, send=lambda *message: sent.put_nowait(message)))
    yield nodes
    nodes.close()


@pytest.fixture
def say(kinds: Any) -> Any:
    """A service."""
    return importlib.import_module("macs_kinds_msgs.srv").Say


def message(name: str, node_type: int, kind: str, manager: str, data: bytes, number: int = 0) -> Message:
    metadata = Metadata(2, 5, number, manager, node_type, node_name(name), f"macs_kinds_msgs/{kind}")
    return Message("unity", 5, metadata, data)


async def test_a_request(nodes: InterfaceNodes, sent: Sent, peer: Peer, say: Any) -> None:
    """Its caller hears that it is none."""
    await peer.service(say, "/say", lambda _, response: response, nodes.robot.session)
    await nodes.add(adding("/say", "macs_kinds_msgs/Say", node_type=NodeType.CLIENT))
    nodes.deliver(message("/say", NodeType.CLIENT, "Say", CallFailure.manager, HALF))
    _, _, data = await get(sent)
    assert decode_data(CallFailure, data).kind == "invalid"


async def test_an_answer(nodes: InterfaceNodes, sent: Sent, peer: Peer, say: Any) -> None:
    """The ROS node that called hears that the call failed."""
    await nodes.add(adding("/say", "macs_kinds_msgs/Say", node_type=NodeType.SERVICE))
    client = await peer.session.run(lambda: peer.session.node.create_client(say, "/say"))
    await until(client.service_is_ready)
    answered: list[Any] = []
    await peer.session.run(
        lambda: client.call_async(say.Request()).add_done_callback(lambda done: answered.append(done.result()))
    )
    _, metadata, _ = await get(sent)
    nodes.deliver(message("/say", NodeType.SERVICE, "Say", "", HALF, metadata.request_id))
    await until(lambda: answered)
    assert nodes.drops["bad_cdr"] == 1


async def test_a_goal(nodes: InterfaceNodes, sent: Sent, peer: Peer, kinds: Any) -> None:
    """It is refused, and not kept."""
    tell = importlib.import_module("macs_kinds_msgs.action").Tell
    server = await peer.session.run(lambda: ActionServer(peer.session.node, tell, "/tell", lambda goal: tell.Result()))
    await known_action(nodes.robot.session, "/tell")
    await nodes.add(adding("/tell", "macs_kinds_msgs/Tell", node_type=NodeType.ACTION))
    goal = bytes(16)
    nodes.deliver(message("/tell", NodeType.ACTION, "Tell", ActionVerb.GOAL.value, goal + HALF))
    _, metadata, data = await get(sent)
    assert (metadata.message_manager, data[:17]) == (ActionVerb.ACCEPTED.value, goal + b"\0")
    node = nodes.on_topic(NodeType.ACTION, "/tell")
    assert node is not None
    assert not node.status().goals
    await peer.session.run(server.destroy)
