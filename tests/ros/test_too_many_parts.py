"""What takes long to translate or to read is refused, and holds up no stop."""

from __future__ import annotations

import asyncio
import struct
import threading
from collections.abc import AsyncIterator
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from rcl_interfaces.srv import GetParameters
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bridge.ros.interface import Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.ros.topics import PublisherNode
from bridge.ros.types import shape_of
from bridge.ros.unity_cdr import PARTS, Parts, TooManyParts, UnityCdr, readable, to_ros
from bridge.settings import RobotSettings, TopicRule
from macs_zenoh.protocol.messages import CallFailure, Metadata, NodeType, decode_data, node_name
from macs_zenoh.protocol.reading import Message
from tests.ros import unity_serializer
from tests.support.ros_peer import Peer, adding, command, drive
from tests.support.waiting import get, until

EMPTY = struct.pack("<I4x", 1)
"""A string without letters."""
MANY = 1 << 18
NAMES = b"\x00\x01\x00\x00" + struct.pack("<I", MANY) + EMPTY * MANY
"""GetParameters' request, with so many names."""
JOINTS = b"\x00\x01\x00\x00" + bytes(8) + EMPTY + struct.pack("<I", MANY) + EMPTY * MANY + bytes(12)

Sent = asyncio.Queue[Any]


@pytest.fixture
async def sent() -> Sent:
    """What the robot sends to single headsets."""
    return asyncio.Queue()


@pytest.fixture
async def nodes(session: RosSession, sent: Sent) -> AsyncIterator[InterfaceNodes]:
    rules = [TopicRule(match="/cmd_vel", deadman_s=60, deadman_message={"linear": {"z": -1}})]
    robot = Robot(session, 7, lambda node, frame: None, rules=Rules(RobotSettings(rules=rules)))
    robot.send = lambda *message: sent.put_nowait(message)
    nodes = InterfaceNodes(robot)
    await nodes.open_stop("/emergency_stop")
    yield nodes
    nodes.close()


def called(service: str, node_type: int, data: bytes, number: int = 0) -> Message:
    manager = CallFailure.manager if node_type == NodeType.CLIENT else ""
    metadata = Metadata(2, 5, number, manager, node_type, node_name(service), "rcl_interfaces/GetParameters")
    return Message("unity", 5, metadata, data)


# -- pure ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("written", [unity_serializer.write, serialize_message])
def test_large_arrays_of_numbers_have_few_parts(written: Any) -> None:
    """They are copied whole, however large; so is a trajectory of a thousand points."""
    point = JointTrajectoryPoint(positions=[1.0] * 7, velocities=[1.0] * 7, accelerations=[1.0] * 7)
    for message in (
        Float64MultiArray(data=[0.5] * 100_000),
        JointTrajectory(joint_names=["joint"] * 7, points=[point] * 1000),
    ):
        kind = type(message)
        read = readable(UnityCdr.of(shape_of(kind)), Parts.of(shape_of(kind)), bytes(written(message)))
        assert deserialize_message(read, kind) == message
    assert Parts.of(shape_of(Image)) is None


def test_many_parts_are_not_even_looked_at() -> None:
    """Nor in the form of Unity, nor where nothing has to be translated, nor in a byte order that nobody counts."""
    for cdr in (JOINTS, JOINTS[:-12] + bytes(4)):
        with pytest.raises(TooManyParts, match=f"more than {PARTS} parts"):
            to_ros(UnityCdr.of(shape_of(JointState)), cdr)
    parts = Parts.of(shape_of(GetParameters.Request))
    assert parts is not None
    for cdr in (NAMES, b"\x00\x00\x00\x00" + NAMES[4:]):
        with pytest.raises(TooManyParts):
            parts.check(cdr)
    parts.check(NAMES, MANY)


# -- on ROS ----------------------------------------------------------------------------------------------------------


async def test_a_command_of_many_parts_is_refused(nodes: InterfaceNodes, peer: Peer) -> None:
    """It is counted as too large, and one that has few comes through."""
    received = await peer.subscription(JointState, "/joints")
    await until(lambda: nodes.robot.session.node.count_subscribers("/joints") == 1)
    await nodes.add(adding("/joints", "sensor_msgs/JointState", node_type=NodeType.PUBLISHER))
    nodes.deliver(command("/joints", JOINTS, "sensor_msgs/JointState"))
    nodes.deliver(command("/joints", JointState(name=["a"])))
    assert await get(received) == JointState(name=["a"])
    assert nodes.drops["too_large"] == 1


async def test_no_topic_holds_up_the_stop_message_of_another(nodes: InterfaceNodes, peer: Peer) -> None:
    """While a command to a topic that was registered before is published, a stop reaches what moves the robot."""
    received = await peer.subscription(Twist, "/cmd_vel")
    await until(lambda: nodes.robot.session.node.count_subscribers("/cmd_vel") == 1)
    for topic, kind in (("/joints", "sensor_msgs/JointState"), ("/cmd_vel", "geometry_msgs/Twist")):
        await nodes.add(adding(topic, kind, node_type=NodeType.PUBLISHER))
    nodes.deliver(drive(1.0))
    assert (await get(received)).linear.x == 1.0
    joints = nodes.on_topic(NodeType.PUBLISHER, "/joints")
    assert isinstance(joints, PublisherNode)
    held, done = threading.Event(), threading.Event()

    def publish_for_long() -> None:
        with joints.lock:
            held.set()
            done.wait()

    publishing, stop = threading.Thread(target=publish_for_long), nodes.stop
    assert stop is not None
    publishing.start()
    held.wait()
    pressing = asyncio.create_task(asyncio.to_thread(stop.press, "operator"))
    try:
        assert (await get(received)).linear.z == -1.0
        await pressing
    finally:
        done.set()
        publishing.join()


async def test_a_request_of_many_parts_is_refused(nodes: InterfaceNodes, sent: Sent) -> None:
    """Its caller hears why."""
    await nodes.add(adding("/get", "rcl_interfaces/GetParameters", node_type=NodeType.CLIENT))
    nodes.deliver(called("/get", NodeType.CLIENT, NAMES))
    _, _, data = await get(sent)
    failure = decode_data(CallFailure, data)
    assert (failure.kind, f"more than {PARTS} parts" in failure.reason) == ("invalid", True)


async def test_an_answer_of_many_parts_is_refused(nodes: InterfaceNodes, sent: Sent, peer: Peer) -> None:
    """The ROS node that waits for it gets the answer of a call that failed."""
    await nodes.add(adding("/get", "rcl_interfaces/GetParameters", node_type=NodeType.SERVICE))
    client = await peer.session.run(lambda: peer.session.node.create_client(GetParameters, "/get"))
    await until(client.service_is_ready)
    answered: list[Any] = []
    await peer.session.run(
        lambda: client.call_async(GetParameters.Request()).add_done_callback(lambda f: answered.append(f.result()))
    )
    _, metadata, _ = await get(sent)
    values = b"\x00\x01\x00\x00" + struct.pack("<I", MANY) + bytes(56) * MANY
    nodes.deliver(called("/get", NodeType.SERVICE, values, metadata.request_id))
    await until(lambda: answered)
    assert answered == [GetParameters.Response()]
    assert nodes.drops["bad_cdr"] == 1
