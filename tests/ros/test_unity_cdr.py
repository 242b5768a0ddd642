"""Each kind of type as Unity's serializer and as ROS write it: to and fro, and through each kind of interface node."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Point
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import BatteryState, CameraInfo, JointState, LaserScan, PointCloud2
from std_msgs.msg import Bool, ByteMultiArray, Empty, Float64MultiArray, Int64MultiArray, String
from std_srvs.srv import Empty as EmptyService
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bridge.gateway import Gateway
from bridge.headset.client import Headset
from bridge.ros import types
from bridge.ros.interface import Registrant, Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.program import open_robot
from bridge.ros.session import RosSession
from bridge.ros.shapes import least_cdr_bytes
from bridge.ros.types import shape_of
from bridge.ros.unity_cdr import UnityCdr, to_ros, to_unity
from bridge.settings import GatewaySettings, RobotSettings, Settings
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.existing import Data, fitting
from macs_zenoh.protocol.messages import Metadata, NodeType, node_name
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.wire import encode_frame, encode_message, parse_frame
from tests.ros import unity_serializer
from tests.support.ros_peer import Peer, adding, command, reaches
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, get, until

pytestmark = pytest.mark.timeout(600)  # the first of them compiles its messages, on a busy machine for minutes

POINT = JointTrajectoryPoint(positions=[1.0, 2.0, 3.0])
POINT.time_from_start.sec = 5


def _kinds(module: Any) -> list[Any]:
    nothing = module.Nothing()
    full = module.Kinds(
        before=1, truth=True, octet=b"\xff", letter=200, i8=-128, u8=255, i16=-(1 << 15), u16=(1 << 16) - 1,
        i32=-(1 << 31), u32=(1 << 32) - 1, i64=-(1 << 63), u64=(1 << 64) - 1, f32=0.5, f64=-1e300, text="Grüße 😀",
        short_text="12345678", wide="hé😀", short_wide="é😀", doubles=[1.0, 2.0], after_doubles=7, longs=[-1],
        few_longs=[1, 2, 3], after_longs=-9, truths=[True, False, True], octets=[b"\x00", b"\xff"], letters=[0, 255],
        data=[1, 2, 3], shorts=[-1], floats=[0.25], texts=["", "a"], short_texts=["b"], wides=["", "ü", "abc"],
        nothings=[nothing] * 3, three_truths=[True, False, True], two_octets=[b"\x80", b"\x01"],
        three_doubles=[1.0, 2.0, 3.0], two_texts=["x", ""], points=[Point(x=1.0)], last_doubles=[4.0],
    )  # fmt: skip
    some = module.Kinds(before=3, after_doubles=200, after_longs=-5, u8=9, doubles=[1.5], text="abc")
    return [module.Kinds(), full, some, nothing, module.Defaults()]


MESSAGES = [
    Empty(),
    Bool(data=True),
    String(),
    String(data="Grüße"),
    ByteMultiArray(data=[b"\x00", b"\xff"]),
    Float64MultiArray(),
    Float64MultiArray(data=[1.0]),
    Int64MultiArray(data=[1, -1]),
    JointState(),
    JointState(name=["a", "bc"], position=[1.0, 2.0]),
    JointState(name=["a"], position=[1.0], effort=[3.0]),
    JointState(name=["a"], velocity=[2.0]),
    JointTrajectory(joint_names=["a", "b", "c"], points=[POINT, JointTrajectoryPoint(effort=[1.0]), POINT]),
    CameraInfo(width=5, distortion_model="plumb_bob"),
    CameraInfo(d=[0.1, 0.2]),
    LaserScan(ranges=[1.0, 2.0, 3.0]),
    PointCloud2(data=[1, 2, 3], is_dense=True),
    BatteryState(cell_voltage=[3.5]),
    EmptyService.Request(),
    EmptyService.Response(),
    Trigger.Request(),
    Trigger.Response(success=True),
    SetBool.Response(success=True, message="ok"),
]


@pytest.fixture(scope="session")
def messages(kinds: Any) -> list[Any]:
    """One of each kind, and what robots really send."""
    return [*MESSAGES, *_kinds(kinds)]


def test_what_a_headset_writes_is_what_ros_reads(messages: list[Any]) -> None:
    """Every kind of message as Unity's serializer writes it has its values in rclpy, and is never judged too short."""
    for message in messages:
        kind = type(message)
        sent = unity_serializer.write(message)
        assert len(sent) >= least_cdr_bytes(shape_of(kind)), message
        assert deserialize_message(to_ros(UnityCdr.of(shape_of(kind)), sent), kind) == message


def test_what_ros_writes_is_what_a_headset_reads(messages: list[Any]) -> None:
    """Every kind of message as rclpy writes it has its values in Unity's deserializer, and deafens none."""
    for message in messages:
        sent = to_unity(UnityCdr.of(shape_of(type(message))), bytes(serialize_message(message)))
        assert unity_serializer.read(type(message), sent) == message


def test_nothing_more_than_needed_follows_what_a_headset_reads(messages: list[Any]) -> None:
    """Of a type that is translated at all, it gets just what its own serializer would have written."""
    for message in messages:
        both = UnityCdr.of(shape_of(type(message)))
        if both is not None:
            assert both.to_unity(bytes(serialize_message(message))) == unity_serializer.write(message)


def test_what_ros_reads_already_stays_as_it_is(messages: list[Any]) -> None:
    """A newer headset writes what ROS writes, without anything behind it; it is not touched."""
    for message in messages:
        both = UnityCdr.of(shape_of(type(message)))
        if both is not None:
            exact = both.to_ros(unity_serializer.write(message))
            assert both.to_ros(exact) == exact
            assert deserialize_message(both.to_ros(exact), type(message)) == message


def test_types_on_which_both_agree_cost_nothing() -> None:
    """Only types that have a sequence of 8 byte numbers, a structure without fields or a wstring are translated."""
    differ, agree = set(), set()
    for package in sorted((Path(sys.prefix) / types._INDEX).iterdir()):
        for entry in package.read_text().split():
            if entry.startswith("msg/") and entry.endswith(".msg"):
                name = f"{package.name}/{entry[4:-4]}"
                (agree if UnityCdr.of(shape_of(types.resolve(name))) is None else differ).add(name)
    assert {"std_msgs/Empty", "sensor_msgs/JointState", "trajectory_msgs/JointTrajectory"} <= differ
    assert {"geometry_msgs/Twist", "sensor_msgs/Image", "sensor_msgs/PointCloud2", "nav_msgs/Odometry"} <= agree
    assert {"std_msgs/String", "sensor_msgs/LaserScan", "nav_msgs/OccupancyGrid", "std_msgs/Bool"} <= agree


@pytest.mark.parametrize(
    "cdr",
    [
        b"",
        b"\x00\x01\x00",
        b"\x00\x00\x00\x00",
        b"\x00\x01\x00\x00" + b"\xff" * 3,
        b"\x00\x01\x00\x00" + b"\xff" * 64,
        b"\x00\x01\x00\x00" + bytes(11),
        b"\x00\x01\x00\x00" + b"\xff\xff\xff\x7f" * 20,
    ],
)
def test_what_is_no_message_stays_what_it_is(cdr: bytes, kinds: Any) -> None:
    """Bytes that fit neither form are left to whoever judges them, soon."""
    for kind in (JointState, kinds.Kinds):
        both = UnityCdr.of(shape_of(kind))
        assert both is not None
        assert both.to_ros(cdr) == cdr
        assert to_unity(both, cdr) == cdr or both.to_unity(cdr) is not None


def test_a_message_without_fields_is_not_taken_for_one_cut_short(kinds: Any) -> None:
    """Gateways know few types: what the robot sends of one without fields passes them and is read by a headset, and
    what is cut short stays so."""
    metadata = Metadata(1, 7, 0, "", 1, "nd__nothing", "macs_kinds_msgs/Nothing")
    for kind, whole in ((kinds.Nothing, True), (Empty, True), (JointState, False)):
        both = UnityCdr.of(shape_of(kind))
        data = to_unity(both, bytes(serialize_message(kind())) if whole else NOTHING)
        frame = parse_frame(encode_frame(2, (5,), message=encode_message(metadata.encode(), data)))
        assert len(fitting(frame, Data.CDR, metadata)[0]) == whole
        assert not whole or unity_serializer.read(kind, data) == kind()
    assert to_unity(UnityCdr.of(shape_of(kinds.Nothing)), NOTHING) == NOTHING


async def test_a_type_of_ones_own_without_fields_reaches_an_existing_headset(
    kinds: Any, domain: int, peer: Peer
) -> None:
    """From a ROS topic over the mesh and its gateway, each message."""
    async with AsyncExitStack() as stack:
        router = await stack.enter_async_context(Router())
        mesh = MeshSettings(connect=[router.endpoint])
        settings = Settings(mesh=mesh, robot=RobotSettings(id=7))
        await stack.enter_async_context(open_robot(settings, domain_id=domain))
        gateway = Gateway(await stack.enter_async_context(await Mesh.open(mesh)), GatewaySettings(port=0))
        stack.push_async_callback(gateway.close)
        await gateway.start()
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port, extensions=0))
        topic = await headset.subscribe("/nothing", "macs_kinds_msgs/Nothing", agents=[7])
        publisher = await peer.publisher(kinds.Nothing, "/nothing", matched=1)
        for _ in range(3):
            await peer.session.run(lambda: publisher.publish(kinds.Nothing()))
            message = await asyncio.wait_for(topic.__anext__(), PATIENCE_S)
            assert unity_serializer.read(kinds.Nothing, bytes(message.data)) == kinds.Nothing()
        assert gateway.drops.total() == 0


# -- through interface nodes -----------------------------------------------------------------------------------------

NOTHING = b"\x00\x01\x00\x00"
"""A message without fields, as an existing headset sends it."""

Sent = asyncio.Queue[tuple[Registrant, Metadata, bytes]]


@pytest.fixture
async def sent() -> Sent:
    """What the robot sends to single headsets."""
    return asyncio.Queue()


@pytest.fixture
async def nodes(session: RosSession, sent: Sent) -> AsyncIterator[InterfaceNodes]:
    def send(*message: Any) -> None:
        sent.put_nowait(message)

    nodes = InterfaceNodes(Robot(session, 7, lambda node, frame: None, send=send))
    yield nodes
    nodes.close()


def of_service(service: str, node_type: int, data: bytes, number: int = 0) -> Message:
    """A headset's request (type 3) or answer (type 4)."""
    return Message("unity", 5, Metadata(2, 5, number, "", node_type, node_name(service), "std_srvs/Trigger"), data)


async def test_a_command_without_fields_reaches_ros(nodes: InterfaceNodes, peer: Peer) -> None:
    """Take off and land are std_msgs/Empty: ROS gets the byte that it needs, whoever left it out."""
    received = await peer.subscription(Empty, "/takeoff")
    await nodes.add(adding("/takeoff", "std_msgs/Empty", node_type=2, unity_cdr=True))
    await reaches(nodes, "/takeoff")
    for data in (NOTHING, NOTHING + b"\0", bytes(serialize_message(Empty()))):
        nodes.deliver(command("/takeoff", data, "std_msgs/Empty"))
        assert await get(received) == Empty()
    assert not nodes.drops


async def test_a_trajectory_keeps_its_times(nodes: InterfaceNodes, peer: Peer) -> None:
    """Points with positions only, as an existing headset writes them, arrive with the time that it said."""
    message = JointTrajectory(joint_names=["a", "b", "c"], points=[POINT])
    received = await peer.subscription(JointTrajectory, "/arm")
    await nodes.add(adding("/arm", "trajectory_msgs/JointTrajectory", node_type=2, unity_cdr=True))
    await reaches(nodes, "/arm")
    nodes.deliver(command("/arm", unity_serializer.write(message)))
    assert await get(received) == message


@pytest.mark.parametrize(("kind", "unity"), [(Trigger, True), (EmptyService, True), (Trigger, False)])
async def test_a_call_without_fields_reaches_ros(
    nodes: InterfaceNodes, sent: Sent, peer: Peer, kind: Any, unity: bool
) -> None:
    """A Trigger or an Empty is called, and answered in the form that its caller reads."""
    calls: list[Any] = []

    def serve(request: Any, response: Any) -> Any:
        calls.append(request)
        if kind is Trigger:
            response.success = True
        return response

    await peer.service(kind, "/do", serve, nodes.robot.session)
    registration = adding("/do", f"std_srvs/{kind.__name__}", node_type=3, **({"unity_cdr": True} if unity else {}))
    await nodes.add(registration)
    nodes.deliver(of_service("/do", NodeType.CLIENT, NOTHING))
    _, _, data = await get(sent)
    assert len(calls) == 1
    if unity:
        assert unity_serializer.read(kind.Response, data) == calls_answer(kind)
        assert kind is Trigger or data == NOTHING + b"\0"
    else:
        assert deserialize_message(data, kind.Response) == calls_answer(kind)


def calls_answer(kind: Any) -> Any:
    return kind.Response(success=True) if kind is Trigger else kind.Response()


@pytest.mark.parametrize("kind", [Trigger, EmptyService])
async def test_a_service_without_fields_is_served(nodes: InterfaceNodes, sent: Sent, peer: Peer, kind: Any) -> None:
    """The headset gets a request that it can read, and its answer without fields is taken for one."""
    await nodes.add(adding("/do", f"std_srvs/{kind.__name__}", node_type=4, unity_cdr=True))
    client = await peer.session.run(lambda: peer.session.node.create_client(kind, "/do"))
    await until(client.service_is_ready)
    loop = asyncio.get_running_loop()
    answered: asyncio.Future[Any] = loop.create_future()

    def call() -> None:
        client.call_async(kind.Request()).add_done_callback(
            lambda future: loop.call_soon_threadsafe(answered.set_result, future.result())
        )

    await peer.session.run(call)
    _, metadata, data = await get(sent)
    assert data == NOTHING + b"\0"
    assert unity_serializer.read(kind.Request, data) == kind.Request()
    answer = unity_serializer.write(calls_answer(kind))
    nodes.deliver(of_service("/do", NodeType.SERVICE, answer, metadata.request_id))
    assert await asyncio.wait_for(answered, PATIENCE_S) == calls_answer(kind)
    assert not nodes.drops
