"""The robot agent end to end: a real Zenoh router, a headset on the mesh, real ROS nodes."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable

import pytest
from geometry_msgs.msg import Twist
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from ros_peer import Peer, adding, command, get, removing, until
from std_msgs.msg import String

import macs_zenoh
from bridge.ros.agent import RobotAgent, open_robot
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings, RobotSettings, Settings
from macs_zenoh.errors import Refused
from macs_zenoh.keyexpr import STREAM
from macs_zenoh.mesh import Mesh, Sample
from macs_zenoh.messages import Functionality, Metadata, NodeType, StreamData, decode_data, decode_management
from macs_zenoh.messages import encode_data as encode
from macs_zenoh.wire import parse_frame

ROBOT = 7


@pytest.fixture
async def router() -> AsyncIterator[str]:
    """A Zenoh router; its endpoint."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    async with await Mesh.open(MeshSettings(mode="router", listen=[endpoint])):
        yield endpoint


@pytest.fixture
async def robot(router: str, domain: int) -> AsyncIterator[RobotAgent]:
    """Robot 7 in group 3."""
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=ROBOT, group=3))
    async with open_robot(settings, domain_id=domain) as robot:
        yield robot


@pytest.fixture
async def headset(router: str, robot: RobotAgent) -> AsyncIterator[Agent]:
    """Headset 5, a Python agent, which knows of the robot."""
    async with macs_zenoh.join("unity", id=5, connect=[router]) as headset:
        await until(lambda: (1, ROBOT) in headset.directory)
        yield headset


class Streams:
    """Everything that robot 7 streams, as an agent on the mesh gets it."""

    def __init__(self, agent: Agent) -> None:
        self.frames: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue()
        self._subscription = agent.mesh.subscribe(STREAM.every(type=1, id=ROBOT), self._take)

    def _take(self, batch: list[Sample]) -> None:
        for key, payload in batch:
            self.frames.put_nowait((key, payload))

    async def after(self, publish: Callable[[], None]) -> tuple[str, bytes]:
        """Key and frame of what comes when ``publish`` is done, again and again until something comes.

        The first can be earlier than the robot's router knows of our subscription.
        """

        def again() -> bool:
            publish()
            return not self.frames.empty()

        await until(again)
        return await get(self.frames)


async def test_a_registered_topic_is_streamed(robot: RobotAgent, headset: Agent, peer: Peer) -> None:
    """After add_node, each message of the topic is on the robot's stream key, whole and addressed."""
    streams = Streams(headset)
    assert await headset.call("ros", ROBOT, "add_node", encode(adding("/chatter"))) == b""
    publisher = await peer.publisher(String, "/chatter", matched=1)
    key, payload = await streams.after(lambda: publisher.publish(String(data="hello")))
    frame = parse_frame(payload)
    assert key == STREAM.of(type=1, id=ROBOT, node="nd__chatter")
    assert decode_management(frame.management) == StreamData({"2": [5]})
    assert Metadata.decode(frame.metadata).sender_agent_id == ROBOT
    assert deserialize_message(bytes(frame.body), String).data == "hello"


async def test_a_command_reaches_a_ros_topic(robot: RobotAgent, headset: Agent, peer: Peer) -> None:
    """What a headset sends, even right before its registration, arrives at the ROS node."""
    received = await peer.subscription(Twist, "/cmd_vel")
    await until(lambda: robot.session.node.count_subscribers("/cmd_vel") == 1)
    twist = Twist()
    twist.linear.x = 0.5
    message = command("/cmd_vel", twist, "geometry_msgs/Twist")
    headset.send(message.data, to="ros", ids=[ROBOT], metadata=message.metadata)
    request = adding("/cmd_vel", "geometry_msgs/Twist", node_type=NodeType.PUBLISHER)
    await headset.call("ros", ROBOT, "add_node", encode(request))
    assert await get(received) == twist
    headset.send(message.data, to="ros", groups=[3], metadata=message.metadata)
    assert await get(received) == twist
    assert not robot.nodes.drops


async def test_a_best_effort_topic_is_streamed(robot: RobotAgent, headset: Agent, peer: Peer) -> None:
    """A sensor's topic arrives end to end."""
    streams = Streams(headset)
    sensor = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = await peer.publisher(String, "/scan", sensor)
    await headset.call("ros", ROBOT, "add_node", encode(adding("/scan")))
    _, payload = await streams.after(lambda: publisher.publish(String(data="seen")))
    assert deserialize_message(bytes(parse_frame(payload).body), String).data == "seen"


BAD_REGISTRATIONS = [
    (encode(adding("/t", "std_msgs/NoSuch")), "not installed on this robot"),
    (encode(adding("/t", node_type=4)), "not supported yet"),
    (encode(removing("/t")), "missing required field"),
    (b"{}", "missing required field"),
    (b"\xff", "not valid JSON"),
    (b"", "not valid JSON"),
]


async def test_a_bad_registration_is_refused(robot: RobotAgent, headset: Agent) -> None:
    """Whatever is wrong, the headset's side hears why, and the robot goes on."""
    for request, reason in BAD_REGISTRATIONS:
        with pytest.raises(Refused, match=reason):
            await headset.call("ros", ROBOT, "add_node", request)
    await headset.call("ros", ROBOT, "add_node", encode(adding("/t")))


async def test_a_collision_is_refused(robot: RobotAgent, headset: Agent) -> None:
    """/a/b and /a_b cannot both be registered, and the second is told so."""
    await headset.call("ros", ROBOT, "add_node", encode(adding("/a/b")))
    with pytest.raises(Refused, match="same node name nd__a_b"):
        await headset.call("ros", ROBOT, "add_node", encode(adding("/a_b")))


async def test_removing_ends_the_subscription(robot: RobotAgent, headset: Agent, peer: Peer) -> None:
    """After remove_node by the last registrant nothing of it is left in ROS."""
    await headset.call("ros", ROBOT, "add_node", encode(adding("/chatter")))
    await peer.sees("/chatter", subscriptions=1)
    await headset.call("ros", ROBOT, "remove_node", encode(removing("/chatter")))
    await peer.sees("/chatter", subscriptions=0)


async def test_a_headset_that_vanishes_is_forgotten(robot: RobotAgent, router: str, peer: Peer) -> None:
    """When its presence ends, its interface nodes end."""
    async with macs_zenoh.join("unity", id=9, connect=[router]) as headset:
        await headset.call("ros", ROBOT, "add_node", encode(adding("/chatter", registrant=9)))
        await peer.sees("/chatter", subscriptions=1)
    await peer.sees("/chatter", subscriptions=0)
    assert len(robot.nodes) == 0


async def test_the_robot_says_what_it_offers(robot: RobotAgent, headset: Agent, peer: Peer) -> None:
    """Topics and services of others with their types; our own interface nodes and ROS's plumbing are left out."""
    await peer.publisher(String, "/chatter")
    await peer.subscription(Twist, "/cmd_vel")
    await headset.call("ros", ROBOT, "add_node", encode(adding("/ours")))

    async def offered() -> Functionality:
        return decode_data(Functionality, await headset.call("ros", ROBOT, "offers"))

    expected = Functionality({"/cmd_vel": "geometry_msgs/msg/Twist"}, {"/chatter": "std_msgs/msg/String"}, {})
    while (found := await offered()) != expected:
        assert found.subscribers.keys() <= expected.subscribers.keys()
        assert found.publishers.keys() <= expected.publishers.keys()


async def test_messages_that_mean_nothing_harm_nothing(robot: RobotAgent, headset: Agent, peer: Peer) -> None:
    """Odd metadata of any kind costs that message; the next command arrives."""
    received = await peer.subscription(String, "/orders")
    await until(lambda: robot.session.node.count_subscribers("/orders") == 1)
    await headset.call("ros", ROBOT, "add_node", encode(adding("/orders", node_type=NodeType.PUBLISHER)))
    good = command("/orders", String(data="good"))
    for metadata in (
        None,
        Metadata(),
        Metadata(message_manager="NoSuchManager"),
        Metadata(node_type=0, node_name="nd__orders"),
        Metadata(node_type=255, node_name="nd__orders"),
        Metadata(node_type=1, node_name="nd__orders"),
        Metadata(node_type=2, node_name="nd_" + "x" * 10_000),
        Metadata(node_type=2, node_name="nd__ordres\n\x00"),
    ):
        headset.send(good.data, to="ros", ids=[ROBOT], metadata=metadata)
    for data in (b"", b"\x00", b"\xff" * 100, good.data[:5]):
        headset.send(data, to="ros", ids=[ROBOT], metadata=good.metadata)
    headset.send(good.data, to="ros", ids=[ROBOT], metadata=good.metadata)
    assert (await get(received)).data == "good"
    assert received.empty()
