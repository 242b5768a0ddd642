"""Interface nodes on real ROS topics."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_msgs.msg import String, UInt8MultiArray

from bridge.ros.early import EarlyMessages, NodeKey
from bridge.ros.interface import Registrant, Robot
from bridge.ros.nodes import InterfaceNodes
from bridge.ros.rules import Rules
from bridge.ros.session import RosSession
from bridge.settings import RobotSettings
from macs_zenoh.errors import Refused
from macs_zenoh.protocol.messages import DataRefused, Metadata, NodeType, StreamData, decode_data, decode_management
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.wire import parse_frame
from tests.support.ros_peer import Peer, adding, command, removing
from tests.support.waiting import get, until

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


class Streams:
    """Takes what subscriber nodes put on the mesh."""

    def __init__(self) -> None:
        self.frames: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue()
        self._loop = asyncio.get_running_loop()

    def put(self, node: str, frame: bytes) -> None:
        self._loop.call_soon_threadsafe(self.frames.put_nowait, (node, frame))

    async def next(self, kind: type[Any] = String) -> tuple[dict[str, list[int]], Any]:
        """The next frame: who receives it, and its message."""
        frame = parse_frame((await get(self.frames))[1])
        management = decode_management(frame.management)
        assert isinstance(management, StreamData)
        return management.dest_agents, deserialize_message(bytes(frame.body), kind)


@pytest.fixture
async def streams() -> Streams:
    return Streams()


@pytest.fixture
async def nodes(session: RosSession, streams: Streams) -> AsyncIterator[InterfaceNodes]:
    nodes = InterfaceNodes(Robot(session, 7, streams.put))
    yield nodes
    nodes.close()


# -- subscriber nodes ------------------------------------------------------------------------------------------------


async def test_topic_data_goes_to_all_registrants_in_one_frame(
    nodes: InterfaceNodes, streams: Streams, peer: Peer
) -> None:
    """One message on the topic is one frame, which names every registrant and carries the message's bytes."""
    await nodes.add(adding("/chatter", registrant=5))
    await nodes.add(adding("/chatter", registrant=300))
    publisher = await peer.publisher(String, "/chatter", matched=1)
    publisher.publish(String(data="hello"))
    node, frame_bytes = await get(streams.frames)
    frame = parse_frame(frame_bytes)
    assert node == "nd__chatter"
    assert frame.header[:3] == (1, (), ())
    assert decode_management(frame.management) == StreamData({"2": [5, 300]})
    assert Metadata.decode(frame.metadata) == Metadata(
        1, 7, 0, "RosAgentSubscriberDataForwarder", NodeType.SUBSCRIBER, "nd__chatter", "std_msgs/String"
    )
    assert deserialize_message(bytes(frame.body), String).data == "hello"
    assert streams.frames.empty()


async def test_a_burst_arrives_complete_and_in_order(nodes: InterfaceNodes, streams: Streams, peer: Peer) -> None:
    """Messages published back to back, as many as the buffer holds, all arrive in order."""
    await nodes.add(adding("/burst", buffer_size=200))
    publisher = await peer.publisher(String, "/burst", QoSProfile(depth=200), matched=1)
    for number in range(200):
        publisher.publish(String(data=str(number)))
    assert [(await streams.next())[1].data for _ in range(200)] == [str(number) for number in range(200)]


async def test_a_large_message_arrives(nodes: InterfaceNodes, streams: Streams, peer: Peer) -> None:
    """A message of 1 MB crosses unchanged."""
    await nodes.add(adding("/large", "std_msgs/UInt8MultiArray"))
    publisher = await peer.publisher(UInt8MultiArray, "/large", matched=1)
    data = bytes(range(256)) * 4096
    publisher.publish(UInt8MultiArray(data=data))
    assert bytes((await streams.next(UInt8MultiArray))[1].data) == data


async def test_registering_again_changes_nothing(
    nodes: InterfaceNodes, streams: Streams, peer: Peer, session: RosSession
) -> None:
    """The same registration twice is one subscription and one copy."""
    for _ in range(2):
        await nodes.add(adding("/chatter"))
    assert len(nodes) == 1
    assert session.node.count_subscribers("/chatter") == 1
    publisher = await peer.publisher(String, "/chatter", matched=1)
    for text in ("one", "two"):
        publisher.publish(String(data=text))
    assert await streams.next() == ({"2": [5]}, String(data="one"))
    assert await streams.next() == ({"2": [5]}, String(data="two"))


async def test_registrations_at_the_same_time_share_a_node(nodes: InterfaceNodes, session: RosSession) -> None:
    """Many headsets that register at once get one subscription."""
    await asyncio.gather(*(nodes.add(adding("/chatter", registrant=i)) for i in range(1, 21)))
    node = nodes.get(NodeType.SUBSCRIBER, "nd__chatter")
    assert node is not None
    assert len(node.registrants) == 20
    assert session.node.count_subscribers("/chatter") == 1


async def test_the_last_registrant_removes_the_node(nodes: InterfaceNodes, streams: Streams, peer: Peer) -> None:
    """Data goes to those who are still registered; without any, the subscription ends."""
    for registrant in (5, 6):
        await nodes.add(adding("/chatter", registrant=registrant))
    publisher = await peer.publisher(String, "/chatter", matched=1)
    nodes.remove(removing("/chatter", registrant=5))
    publisher.publish(String(data="for one"))
    assert await streams.next() == ({"2": [6]}, String(data="for one"))
    nodes.remove(removing("/chatter", registrant=6))
    nodes.remove(removing("/chatter", registrant=6))
    assert len(nodes) == 0
    await peer.sees("/chatter", publishers=1, subscriptions=0)


async def test_a_registrant_that_vanished_is_off_every_node(nodes: InterfaceNodes) -> None:
    """Its nodes go, those of others stay."""
    await nodes.add(adding("/mine", registrant=5))
    await nodes.add(adding("/ours", registrant=5, node_type=NodeType.PUBLISHER))
    await nodes.add(adding("/ours", registrant=6, node_type=NodeType.PUBLISHER))
    nodes.forget(Registrant(2, 5))
    assert nodes.get(NodeType.SUBSCRIBER, "nd__mine") is None
    node = nodes.get(NodeType.PUBLISHER, "nd__ours")
    assert node is not None
    assert node.registrants == {Registrant(2, 6)}


async def test_a_registrant_that_vanishes_while_its_node_opens_leaves_nothing(
    nodes: InterfaceNodes, peer: Peer, session: RosSession
) -> None:
    """No subscription stays behind when its only registrant leaves before it exists."""
    adds = asyncio.create_task(nodes.add(adding("/chatter")))
    await asyncio.sleep(0)
    nodes.forget(Registrant(2, 5))
    await adds
    assert len(nodes) == 0
    await until(lambda: session.node.count_subscribers("/chatter") == 0)


@pytest.mark.parametrize("publisher_first", [True, False])
async def test_a_best_effort_publisher_delivers(
    nodes: InterfaceNodes, streams: Streams, peer: Peer, publisher_first: bool
) -> None:
    """Sensor topics arrive, whether the sensor was there before the registration or comes later."""
    if publisher_first:
        publisher = await peer.publisher(String, "/scan", BEST_EFFORT)
        await _knows(nodes, "/scan", publishers=1)
        await nodes.add(adding("/scan"))
    else:
        await nodes.add(adding("/scan"))
        publisher = await peer.publisher(String, "/scan", BEST_EFFORT)
    await until(lambda: publisher.get_subscription_count() == 1)
    await _repeat(lambda: publisher.publish(String(data="seen")), streams.frames)
    assert (await streams.next())[1].data == "seen"


@pytest.mark.parametrize("publisher_first", [True, False])
async def test_a_latched_topic_gives_its_last_message(
    nodes: InterfaceNodes, streams: Streams, peer: Peer, publisher_first: bool
) -> None:
    """A topic whose publisher keeps its last message gives it to a headset, whichever of the two came first."""
    if publisher_first:
        publisher = await peer.publisher(String, "/map", LATCHED)
        publisher.publish(String(data="the map"))
        await _knows(nodes, "/map", publishers=1)
        await nodes.add(adding("/map"))
    else:
        await nodes.add(adding("/map"))
        publisher = await peer.publisher(String, "/map", LATCHED)
        publisher.publish(String(data="the map"))
    assert (await streams.next())[1].data == "the map"


async def test_a_subscription_adopts_both_kinds_of_publishers(
    nodes: InterfaceNodes, streams: Streams, peer: Peer
) -> None:
    """When a reliable and a best-effort publisher share a topic, both are heard."""
    await nodes.add(adding("/mixed"))
    reliable = await peer.publisher(String, "/mixed", 10, matched=1)
    sensor = await peer.publisher(String, "/mixed", BEST_EFFORT, matched=1)
    seen: set[str] = set()
    while seen != {"reliable", "sensor"}:
        reliable.publish(String(data="reliable"))
        sensor.publish(String(data="sensor"))
        seen.add((await streams.next())[1].data)


# -- publisher nodes -------------------------------------------------------------------------------------------------


async def test_a_command_reaches_the_topic(nodes: InterfaceNodes, peer: Peer) -> None:
    """CDR from a headset is the message that a ROS node receives."""
    received = await peer.subscription(Twist, "/cmd_vel")
    await _knows(nodes, "/cmd_vel", subscriptions=1)
    await nodes.add(adding("/cmd_vel", "geometry_msgs/Twist", node_type=NodeType.PUBLISHER))
    twist = Twist()
    twist.linear.x = 0.5
    nodes.deliver(command("/cmd_vel", twist))
    assert await get(received) == twist


@pytest.mark.parametrize("qos", [BEST_EFFORT, LATCHED, QoSProfile(depth=1)], ids=["best effort", "latched", "plain"])
async def test_a_publisher_fits_the_subscriptions_that_are_there(
    nodes: InterfaceNodes, peer: Peer, qos: QoSProfile
) -> None:
    """Whatever a ROS subscription asks for, a headset's commands reach it."""
    received = await peer.subscription(String, "/orders", qos)
    await _knows(nodes, "/orders", subscriptions=1)
    await nodes.add(adding("/orders", node_type=NodeType.PUBLISHER))
    await _repeat(lambda: nodes.deliver(command("/orders", String(data="go"))), received)
    assert (await get(received)).data == "go"


async def test_a_latching_publisher_serves_late_subscriptions(nodes: InterfaceNodes, peer: Peer) -> None:
    """With isLatched, a ROS node that subscribes later gets the last message."""
    await nodes.add(adding("/goal", node_type=NodeType.PUBLISHER, is_latched=True, buffer_size=1))
    for text in ("old", "last"):
        nodes.deliver(command("/goal", String(data=text)))
    received = await peer.subscription(String, "/goal", LATCHED)
    assert (await get(received)).data == "last"


async def test_commands_before_the_registration_are_delivered(nodes: InterfaceNodes, peer: Peer) -> None:
    """Commands that overtake their registration reach the topic after it, in order."""
    received = await peer.subscription(String, "/orders")
    await _knows(nodes, "/orders", subscriptions=1)
    for number in range(10):
        nodes.deliver(command("/orders", String(data=str(number))))
    await nodes.add(adding("/orders", node_type=NodeType.PUBLISHER))
    assert [(await get(received)).data for _ in range(10)] == [str(number) for number in range(10)]
    assert not nodes.drops


async def test_commands_for_nothing_are_counted_and_logged_once(
    nodes: InterfaceNodes, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A command whose registration never comes is given up; the log says so once per node name."""
    monkeypatch.setattr(EarlyMessages, "HOLD_S", 0.02)
    for expected in (1, 2):
        nodes.deliver(command("/nowhere", b"\0\1\0\0"))
        await until(lambda expected=expected: nodes.drops["no_node"] == expected)
    assert [record.message for record in caplog.records if "nd__nowhere" in record.message] == [
        "nd__nowhere: nobody registered this node with type 2 (logged once, counted as no_node)"
    ]


@pytest.mark.parametrize("vanishes", [True, False])
async def test_who_leaves_as_usual_leaves_no_warning(
    nodes: InterfaceNodes, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, vanishes: bool
) -> None:
    """Commands that its own removal has overtaken are counted, and nobody is alarmed; a stranger's are told."""
    monkeypatch.setattr(EarlyMessages, "HOLD_S", 0.02)
    await nodes.add(adding("/cmd", node_type=2))
    nodes.deliver(command("/cmd", String(data="go")))
    if vanishes:
        nodes.forget(Registrant(2, 5))
    else:
        nodes.remove(removing("/cmd", node_type=2))
    caplog.clear()
    for _ in range(3):
        nodes.deliver(command("/cmd", String(data="late")))
    await asyncio.sleep(0.1)
    assert nodes.drops == {"after_leaving": 3}
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    nodes.deliver(command("/cmd", String(data="who?"))._replace(sender_id=6))
    await until(lambda: nodes.drops["no_node"] == 1)
    await nodes.add(adding("/cmd", node_type=2))  # and who comes back is heard
    node = nodes.get(2, "nd__cmd")
    assert node is not None
    assert node.is_open


async def test_too_many_early_commands_lose_the_oldest(nodes: InterfaceNodes, peer: Peer) -> None:
    """What waits for a registration is bounded; the newest commands win."""
    received = await peer.subscription(String, "/orders", QoSProfile(depth=50))
    await _knows(nodes, "/orders", subscriptions=1)
    for number in range(20):
        nodes.deliver(command("/orders", String(data=str(number))))
    await nodes.add(adding("/orders", node_type=NodeType.PUBLISHER, buffer_size=50))
    assert [(await get(received)).data for _ in range(16)] == [str(number) for number in range(4, 20)]
    assert nodes.drops == {"held_full": 4}


@pytest.mark.parametrize("bad", [b"", b"\x00", b"\x06\x00\x00\x00hello\x00", b"\x00\x01\x00\x00" + bytes(47)])
async def test_bytes_that_are_no_message_never_reach_a_topic(
    nodes: InterfaceNodes, peer: Peer, caplog: pytest.LogCaptureFixture, bad: bytes
) -> None:
    """Impossible CDR is refused, counted and logged once, and the next good command arrives."""
    received = await peer.subscription(Twist, "/cmd_vel")
    await _knows(nodes, "/cmd_vel", subscriptions=1)
    await nodes.add(adding("/cmd_vel", "geometry_msgs/Twist", node_type=NodeType.PUBLISHER))
    for _ in range(3):
        nodes.deliver(command("/cmd_vel", bad))
    twist = Twist()
    twist.angular.z = 1.0
    nodes.deliver(command("/cmd_vel", twist))
    assert await get(received) == twist
    assert nodes.drops == {"bad_cdr": 3}
    assert len([record for record in caplog.records if "/cmd_vel from unity/5" in record.message]) == 1


async def test_data_for_a_subscriber_node_harms_nothing(nodes: InterfaceNodes) -> None:
    """A message that names a node which only sends is counted."""
    await nodes.add(adding("/chatter"))
    message = command("/chatter", b"\0\1\0\0")
    nodes.deliver(message._replace(metadata=Metadata(2, 5, node_type=1, node_name="nd__chatter")))
    assert nodes.drops == {"no_node": 1}


# -- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("topic", "data_type", "options", "reason"),
    [
        ("/t", "std_msgs/NoSuch", {}, "not installed on this robot"),
        ("/t", "os/path", {}, "not the name of a ROS type"),
        ("/t", "no_such_msgs/Thing", {}, "not installed on this robot"),
        ("/t", "std_srvs/srv/SetBool", {}, "a msg type was expected"),
        ("/bad name", "std_msgs/String", {"name": "nd_x"}, "'/bad name' cannot be used on this robot"),
        ("/a//b", "std_msgs/String", {}, "must not contain repeated '/'"),
        ("", "std_msgs/String", {"name": "nd_"}, "must not be empty"),
        ("/" + "x" * 400, "std_msgs/String", {"name": "nd_x"}, "should not exceed"),
        ("/t", "std_msgs/String", {"name": "nd_/../*"}, "not a valid node name"),
        ("/t", "std_msgs/String", {"node_type": 3}, "not installed on this robot: std_msgs is, but has no such type"),
        ("/t", "std_srvs/NoSuch", {"node_type": 4}, "not installed on this robot: std_srvs is, but has no such type"),
        ("/t/set_parameters", "rcl_interfaces/SetParameters", {"node_type": 3}, "is not open to headsets"),
        ("/t", "std_msgs/String", {"node_type": 99}, "type 99 is unknown"),
    ],
)
async def test_what_cannot_be_registered_is_refused(
    nodes: InterfaceNodes, topic: str, data_type: str, options: dict[str, Any], reason: str
) -> None:
    """The reason is one line for a person, and nothing stays behind."""
    with pytest.raises(Refused, match=reason) as refusal:
        await nodes.add(adding(topic, data_type, **options))
    assert "\n" not in refusal.value.reason
    assert len(nodes) == 0


async def test_two_topics_with_one_node_name_collide(nodes: InterfaceNodes) -> None:
    """/a/b and /a_b have the same node name: the second is refused, the first stays."""
    await nodes.add(adding("/a/b"))
    with pytest.raises(Refused, match="/a_b and /a/b have the same node name nd__a_b"):
        await nodes.add(adding("/a_b", registrant=6))
    node = nodes.get(NodeType.SUBSCRIBER, "nd__a_b")
    assert node is not None
    assert (node.topic, node.registrants) == ("/a/b", {Registrant(2, 5)})


async def test_a_node_keeps_its_type(nodes: InterfaceNodes) -> None:
    """A registration of the same topic with another type is refused and names both."""
    await nodes.add(adding("/t"))
    with pytest.raises(Refused, match="registered with type std_msgs/msg/String, not geometry_msgs/msg/Twist"):
        await nodes.add(adding("/t", "geometry_msgs/Twist", registrant=6))


@pytest.mark.parametrize("node_type", [NodeType.SUBSCRIBER, NodeType.PUBLISHER])
async def test_a_topic_of_another_type_is_refused(nodes: InterfaceNodes, peer: Peer, node_type: int) -> None:
    """A topic that other nodes use with another type is refused, naming the type it carries."""
    await peer.publisher(Twist, "/t")
    await _knows(nodes, "/t", publishers=1)
    with pytest.raises(Refused, match="/t has type geometry_msgs/msg/Twist on this robot, not std_msgs/msg/String"):
        await nodes.add(adding("/t", node_type=node_type))


async def test_the_other_node_on_a_topic_must_have_its_type(nodes: InterfaceNodes) -> None:
    """A subscriber and a publisher node on one topic have one type."""
    await nodes.add(adding("/t"))
    with pytest.raises(Refused, match="/t has type std_msgs/msg/String on this robot"):
        await nodes.add(adding("/t", "geometry_msgs/Twist", node_type=NodeType.PUBLISHER))
    await nodes.add(adding("/t", node_type=NodeType.PUBLISHER))


@pytest.mark.parametrize("node_type", [1, 2])
async def test_another_type_in_one_burst_is_what_counts(
    nodes: InterfaceNodes, streams: Streams, node_type: int
) -> None:
    """Who drops a topic and registers it with another type has that one, even when the removal was lost on its way."""
    for removal in (True, False):
        await nodes.add(adding("/burst", "std_msgs/String", node_type=node_type))
        if removal:
            nodes.remove(removing("/burst", node_type=node_type))
        await nodes.add(adding("/burst", "std_msgs/Int32", node_type=node_type))
        node = nodes.get(node_type, "nd__burst")
        assert node is not None
        assert str(node.interface) == "std_msgs/msg/Int32"
        assert node.registrants == {Registrant(2, 5)}
        nodes.remove(removing("/burst", node_type=node_type))
    assert len(nodes) == 0


async def test_a_wrong_first_type_gives_way_to_the_right_one(nodes: InterfaceNodes, told: Told, peer: Peer) -> None:
    """When the topic appears, who registered it with another type is told, and does not keep it from others."""
    await nodes.add(adding("/late", "std_msgs/Int32", registrant=5))
    with pytest.raises(Refused, match="/late is registered with type std_msgs/msg/Int32, not std_msgs/msg/String"):
        await nodes.add(adding("/late", registrant=6))
    publisher = await peer.publisher(String, "/late")
    await until(lambda: nodes.robot.session.node.count_publishers("/late") == 1)
    await _look(nodes)
    to, refused = await told.next()
    assert to == Registrant(2, 5)
    assert (refused.node_name, refused.kind) == ("nd__late", "other_type")
    assert refused.reason == "/late has type std_msgs/msg/String on this robot now, not std_msgs/msg/Int32"
    await nodes.add(adding("/late", registrant=6))
    assert (await told.next())[0] == Registrant(2, 5)  # it has the node no more
    await until(lambda: publisher.get_subscription_count() == 1)


async def test_a_topic_that_returns_with_another_type_is_told_once(
    nodes: InterfaceNodes, told: Told, peer: Peer
) -> None:
    """Every registrant hears that its topic has another type now; when the old one is back all goes on."""
    publisher = await peer.publisher(String, "/changed")
    await _knows(nodes, "/changed", publishers=1)
    for registrant in (5, 6):
        await nodes.add(adding("/changed", registrant=registrant))
    await _look(nodes)
    assert told.queue.empty()
    await peer.session.run(lambda: peer.session.node.destroy_publisher(publisher))
    other = Peer(nodes.robot.session.context.get_domain_id(), "other")
    try:
        await other.publisher(UInt8MultiArray, "/changed")
        await until(lambda: len(dict(nodes.robot.session.node.get_topic_names_and_types())["/changed"]) == 2)
        for _ in range(3):
            await _look(nodes)
        assert {(await told.next())[0].id for _ in range(2)} == {5, 6}
        assert told.queue.empty()
    finally:
        other.session.close()


class Told:
    """What the robot tells single agents."""

    def __init__(self) -> None:
        self.queue: asyncio.Queue[tuple[Registrant, Metadata, bytes]] = asyncio.Queue()

    async def next(self) -> tuple[Registrant, DataRefused]:
        to, metadata, data = await get(self.queue)
        assert metadata.message_manager == DataRefused.manager
        return to, decode_data(DataRefused, data)


@pytest.fixture
async def told(nodes: InterfaceNodes) -> Told:
    told = Told()
    nodes.robot.send = lambda *message: told.queue.put_nowait(message)
    return told


async def _look(nodes: InterfaceNodes) -> None:
    """As the robot agent does when the graph changes."""
    node = nodes.robot.session.node
    await nodes.robot.session.run(
        lambda: nodes.look_at_types(node.get_topic_names_and_types(), node.get_service_names_and_types())
    )
    await asyncio.sleep(0)


async def test_a_message_that_is_too_large_is_dropped_at_its_source(
    session: RosSession, streams: Streams, peer: Peer
) -> None:
    """It is counted and told to each registrant, not often, and what comes after it arrives."""
    rules = Rules(RobotSettings(max_frame_bytes=2000))
    nodes = InterfaceNodes(Robot(session, 7, streams.put, rules=rules))
    told = Told()
    nodes.robot.send = lambda *message: told.queue.put_nowait(message)
    for registrant in (5, 6):
        await nodes.add(adding("/big", registrant=registrant))
    publisher = await peer.publisher(String, "/big", matched=1)
    for _ in range(5):
        publisher.publish(String(data="x" * 2000))
    publisher.publish(String(data="small"))
    assert (await streams.next())[1].data == "small"
    assert nodes.drops == {"too_large": 5}
    refusals = [await told.next() for _ in range(2)]
    assert {to.id for to, _ in refusals} == {5, 6}
    assert {(refused.kind, refused.tos_name, refused.node_type) for _, refused in refusals} == {
        ("too_large", "/big", 1)
    }
    assert "more than max_frame_bytes (2000)" in refusals[0][1].reason
    assert told.queue.empty()
    nodes.close()


async def test_a_refused_name_can_be_registered_properly_after(nodes: InterfaceNodes) -> None:
    """A refusal does not occupy the name."""
    with pytest.raises(Refused):
        await nodes.add(adding("/t", "std_msgs/NoSuch"))
    await nodes.add(adding("/t"))
    assert len(nodes) == 1


async def test_the_number_of_nodes_is_limited(session: RosSession, streams: Streams) -> None:
    """One node more than allowed is refused; registering on those that exist still works."""
    nodes = InterfaceNodes(Robot(session, 7, streams.put), max_nodes=2)
    for topic in ("/a", "/b"):
        await nodes.add(adding(topic))
    with pytest.raises(Refused, match="2 interface nodes, which is its limit"):
        await nodes.add(adding("/c"))
    await nodes.add(adding("/a", registrant=6))
    nodes.close()


async def test_one_agent_cannot_have_all_nodes(session: RosSession, streams: Streams) -> None:
    """An agent that registers as much as it can leaves room for what others need."""
    nodes = InterfaceNodes(Robot(session, 7, streams.put), max_nodes=40)
    for number in range(20):
        await nodes.add(adding(f"/t{number}", registrant=5))
    with pytest.raises(Refused, match="the rest is for others"):
        await nodes.add(adding("/t20", registrant=5))
    await nodes.add(adding("/cmd_vel", registrant=6))
    nodes.close()


async def test_a_failing_mesh_does_not_stop_the_node(session: RosSession, peer: Peer, streams: Streams) -> None:
    """An error while a message is put on the mesh costs that message only."""
    calls = []

    def put(node: str, frame: bytes) -> None:
        calls.append(node)
        if len(calls) == 1:
            raise OSError("broken")
        streams.put(node, frame)

    nodes = InterfaceNodes(Robot(session, 7, put))
    await nodes.add(adding("/chatter"))
    publisher = await peer.publisher(String, "/chatter", matched=1)
    publisher.publish(String(data="lost"))
    await until(lambda: calls)
    publisher.publish(String(data="kept"))
    assert (await streams.next())[1].data == "kept"
    nodes.close()


# -- messages that wait ----------------------------------------------------------------------------------------------


def test_waiting_messages_are_bounded_in_names_and_bytes() -> None:
    """Neither many names nor big messages make the robot keep more than it may."""
    early = EarlyMessages()
    message = command("/t", b"\0\1\0\0")
    for number in range(EarlyMessages.NODES):
        assert not early.hold(NodeKey(2, str(number)), message, now=0.0)
    assert early.hold(NodeKey(2, "one more"), message, now=0.0)
    big = message._replace(data=bytes(EarlyMessages.BYTES))
    assert early.hold(NodeKey(2, "0"), big, now=0.0)
    assert early.next_deadline() == EarlyMessages.HOLD_S
    assert sum(len(messages) for messages in early.expire(EarlyMessages.HOLD_S).values()) == EarlyMessages.NODES
    assert early.next_deadline() is None
    assert not early.hold(NodeKey(2, "0"), big, now=0.0)
    assert early.waiting_for(NodeKey(2, "0")) == [big]
    early.remove(NodeKey(2, "0"), big)
    assert not early.waits((2, big.sender_id))
    assert early._bytes.total() == 0


async def test_a_call_costs_the_same_however_many_wait(nodes: InterfaceNodes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a flood of calls for a node that nobody registered the next one is looked at, and not all that wait."""
    looked: Counter[str] = Counter()
    deliver = InterfaceNodes._deliver

    def counted(self: InterfaceNodes, key: NodeKey, message: Message) -> bool:
        looked["at"] += 1
        return deliver(self, key, message)

    monkeypatch.setattr(InterfaceNodes, "_deliver", counted)
    said = Metadata(node_type=NodeType.CLIENT, node_name="nd__no")
    for _ in range(2 * EarlyMessages.CALLS_PER_NODE):
        nodes.deliver(Message("unity", 300, said, bytes([0, 1, 0, 0])))
    assert nodes.drops["held_full"] == EarlyMessages.CALLS_PER_NODE
    assert looked["at"] <= 2 * 2 * EarlyMessages.CALLS_PER_NODE


def test_who_names_many_nodes_takes_nobodys_place() -> None:
    """What one sender sends before its registration waits, however much others send for nodes that never come, under
    the same names or others; and it comes in the order in which it was sent."""
    early, key, early_message = EarlyMessages(), NodeKey(2, "0"), command("/t", b"\0\1\0\0")
    for flooder in range(12):
        flood = early_message._replace(sender_id=1000 + flooder, data=bytes(100_000))
        for number in range(2 * EarlyMessages.NODES):
            early.hold(NodeKey(2, str(number)), flood, now=0.0)
    mine = [early_message._replace(data=bytes([number])) for number in range(3)]
    for message in mine:
        assert not early.hold(key, message, now=0.1)
    assert [message for message in early.waiting_for(key) if message.sender_id == early_message.sender_id] == mine
    early.expire(5.0)
    assert (early.next_deadline(), early._bytes.total(), early._nodes.total()) == (None, 0, 0)


async def _knows(nodes: InterfaceNodes, topic: str, *, publishers: int = 0, subscriptions: int = 0) -> None:
    """Wait until the robot's node knows of so many endpoints of a topic."""
    node = nodes.robot.session.node
    await until(lambda: node.count_publishers(topic) == publishers and node.count_subscribers(topic) == subscriptions)


async def _repeat(action: Any, received: asyncio.Queue[Any]) -> None:
    """Do it again until something is received: best effort promises nothing for a single message."""

    def once_more() -> bool:
        action()
        return not received.empty()

    await until(once_more)
