"""What a robot takes for a whole message, against what ROS can read."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point32 as Corner
from geometry_msgs.msg import Polygon, PoseStamped, Twist
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState, MultiDOFJointState, PointCloud2, PointField
from std_msgs.msg import Empty, Float64MultiArray, String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bridge.ros import whole
from bridge.ros.interface import Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.session import RosSession
from bridge.ros.shapes import Sequence, Structure, Text
from bridge.ros.types import shape_of
from bridge.ros.whole import Whole
from macs_zenoh.protocol.messages import NodeType
from tests.ros.test_unity_cdr import _kinds
from tests.support.ros_peer import Peer, adding, command, reaches
from tests.support.waiting import get

HEADER = b"\0\1\0\0"
POINT = JointTrajectoryPoint(positions=[1.0, 2.0], effort=[3.0])
POINT.time_from_start.sec = 5
STATUS = DiagnosticStatus(name="arm", values=[KeyValue(key="a", value="b"), KeyValue(key="long", value="")])
FIELDS = [PointField(name=name, offset=4 * n, datatype=7, count=1) for n, name in enumerate("xyz")]
MESSAGES = [
    Empty(),
    Twist(),
    PoseStamped(),
    String(data="Grüße"),
    Float64MultiArray(data=[1.0]),
    JointState(name=["a", "bc"], position=[1.0, 2.0]),
    JointState(name=["a"], velocity=[2.0]),
    JointTrajectory(joint_names=["a", "b", "c"], points=[POINT, JointTrajectoryPoint(effort=[1.0]), POINT]),
    PointCloud2(fields=FIELDS, data=[1, 2, 3] * 5, is_dense=True),
    Polygon(points=[Corner(), Corner()]),
    Path(poses=[PoseStamped(), PoseStamped()]),
    DiagnosticArray(status=[STATUS, STATUS]),
    MultiDOFJointState(joint_names=["a"]),
    SetBool.Response(success=True, message="ok"),
]


def _agrees(message: Any) -> int:
    """That what is taken for whole is what ROS reads the message from, wherever it is cut short; how often it is not.

    What ROS reads of others is not asked: of some it takes a part.
    """
    kind, cdr, refused = type(message), bytes(serialize_message(message)), 0
    checked = Whole(shape_of(kind))
    for size in range(len(HEADER), len(cdr) + 1):
        problem = checked.problem(cdr[:size])
        read = _read(kind, cdr[:size])
        assert (problem is None) is (read == message), (message, size, problem)
        refused += problem is not None
    return refused


def _read(kind: type[Any], cdr: bytes) -> Any:
    try:
        return deserialize_message(cdr, kind)
    except Exception:  # noqa: BLE001 - the middleware's, whatever it is
        return None


def test_what_is_cut_short_is_found_wherever_it_is() -> None:
    """At each byte of each message: refused when ROS cannot read it from that, and only then."""
    assert all(_agrees(message) for message in MESSAGES)


@pytest.mark.timeout(600)
def test_of_every_kind_of_field(kinds: Any) -> None:
    """The same of messages that have all there is."""
    assert all(_agrees(message) for message in _kinds(kinds))


@pytest.mark.parametrize("length", [6, 7, 1000, 65535, (1 << 32) - 1])
@pytest.mark.parametrize("order", ["<", ">"])
def test_a_length_that_is_not_there(length: int, order: str) -> None:
    """A text, numbers, structures and texts that say there are more of them than follow, in either order of bytes."""
    header = b"\0\1\0\0" if order == "<" else b"\0\0\0\0"
    text = header + struct.pack(f"{order}I", length) + b"hello"
    assert Whole(shape_of(String)).problem(text)
    assert Whole(shape_of(String)).problem(header + struct.pack(f"{order}I", 5) + b"hello") is None
    for kind in (Polygon, JointTrajectoryPoint):  # both begin with a sequence
        assert Whole(shape_of(kind)).problem(text)


def test_how_many_parts_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """A message with more of them is refused; numbers are none."""
    monkeypatch.setattr(whole, "MOST", 3)
    checked = Whole(Structure((Sequence(Text()),)))
    assert checked.problem(HEADER + struct.pack("<I", 3) + bytes(12)) is None
    problem = checked.problem(HEADER + struct.pack("<I", 4) + bytes(16))
    assert problem is not None
    assert "more than 3" in problem
    assert Whole(shape_of(PointCloud2)).problem(bytes(serialize_message(PointCloud2(data=[0] * 1000)))) is None


async def test_a_command_that_is_cut_short_is_not_published(session: RosSession, peer: Peer) -> None:
    """The text of a headset says that it is longer than its message: it is refused and counted, the next is heard."""
    nodes = InterfaceNodes(Robot(session, 7, lambda node, frame: None))
    try:
        received = await peer.subscription(String, "/say")
        await nodes.add(adding("/say", node_type=NodeType.PUBLISHER))
        await reaches(nodes, "/say")
        nodes.deliver(command("/say", HEADER + b"\xff\xff\0\0A\0\0\0\0"))
        assert nodes.drops["bad_cdr"] == 1
        nodes.deliver(command("/say", String(data="whole")))
        assert (await get(received)).data == "whole"
    finally:
        nodes.close()
