"""The robot agent end to end: a real Zenoh router, a headset on the mesh, real ROS nodes."""

from __future__ import annotations

import asyncio
import json

import pytest
from geometry_msgs.msg import Twist
from msgspec.structs import replace
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_msgs.msg import Bool, String

import macs_zenoh
from bridge.ros import counts, graph
from bridge.ros.agent import RobotAgent
from bridge.ros.graph import Offered, TopicQos
from bridge.ros.interface import Registrant
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import Refused
from macs_zenoh.mesh import Mesh, panics
from macs_zenoh.protocol.keyexpr import PRESENCE, STREAM
from macs_zenoh.protocol.messages import (
    Functionality,
    FunctionalityRequest,
    Metadata,
    NodeType,
    StreamData,
    decode_data,
    decode_management,
)
from macs_zenoh.protocol.messages import encode_data as encode
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.robot_state import STATUS, StatusRequest, StreamCount
from macs_zenoh.protocol.routing import call
from macs_zenoh.protocol.wire import parse_frame
from tests.support.ros_peer import ROBOT, Peer, Streams, adding, command, removing
from tests.support.waiting import PATIENCE_S, get, until


async def test_a_robot_that_has_ended_has_no_last_words(router: str, domain: int) -> None:
    """Nor do its nodes stay, in a program that has one robot after the other."""
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=ROBOT))
    before = len(list(panics._last_words))
    async with open_robot(settings, domain_id=domain):
        assert len(list(panics._last_words)) == before + 1
    assert len(list(panics._last_words)) == before


async def test_who_was_never_seen_does_not_follow_for_ever(robot: RobotAgent) -> None:
    """Those that asked last are told of changes."""
    for number in range(graph.FOLLOWERS + 5):
        asked = Message("unity", number, Metadata(), b'{"follow": true}')
        robot.offers.follow(Registrant(2, number), asked)
    assert len(robot.offers._followers) == graph.FOLLOWERS
    assert Registrant(2, graph.FOLLOWERS + 4) in robot.offers._followers


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


async def test_how_much_was_put_is_told_behind_it(
    robot: RobotAgent, headset: Agent, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who asks for the robot's state may have itself told, on each topic's stream, what was put there for it: once,
    unless asked for again. Others are told nothing, and other data of a question for the state is ignored."""
    monkeypatch.setattr(counts, "AGAIN_S", 0.0)
    streams = Streams(headset)
    await headset.call("ros", ROBOT, "add_node", encode(adding("/chatter")))
    publisher = await peer.publisher(String, "/chatter", matched=1)
    await streams.after(lambda: publisher.publish(String(data="hello")))
    carried = {}

    async def status(data: bytes) -> int:
        told = json.loads(await headset.call("ros", ROBOT, "status", data))
        carried.update({node["name"]: node["carried"]["messages"] for node in told["nodes"] if "carried" in node})
        return int(carried["/chatter"])

    while await status(b"x") != await status(b"{}"):
        pass
    for asked in (StatusRequest("new"), StatusRequest("new"), StatusRequest("all")):
        await status(encode(asked))
    publisher.publish(String(data="the last"))
    found = []
    while b"the last" not in bytes((frame := parse_frame((await get(streams.frames))[1])).body):
        found.append(frame)
    counted = [frame for frame in found if Metadata.decode(frame.metadata).message_manager == StreamCount.manager]
    assert [decode_data(StreamCount, bytes(frame.body)).put for frame in counted] == [carried["/chatter"]] * 2
    assert found[-2:] == counted
    assert [decode_management(frame.management) for frame in counted] == [StreamData({"2": [5]})] * 2


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


async def test_a_robot_whose_id_another_has_takes_a_free_one(router: str, domain: int, peer: Peer) -> None:
    """A robot that was given no id gives way to another one of the same id: it goes on under a new one, without what
    was registered under the old one, and an emergency stop still holds."""
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(stop_topic="/stop"))
    async with (
        open_robot(settings, domain_id=domain) as robot,
        macs_zenoh.join("unity", id=5, connect=[router]) as headset,
    ):
        await until(lambda: (1, 1) in headset.directory)
        await headset.call("ros", 1, "add_node", encode(adding("/chatter")))
        await headset.call("ros", 1, "stop", b"true")
        other = headset.mesh.declare_token(PRESENCE.of(type=1, id=1, group=0, zid="0"))
        await until(lambda: (1, 2) in headset.directory and robot.agent.id == 2)
        status = json.loads(await headset.call("ros", 2, "status"))
        assert status["stopped"]
        assert "/chatter" not in [node["name"] for node in status["nodes"]]
        await headset.call("ros", 2, "add_node", encode(adding("/chatter")))
        streams = Streams(headset, 2)
        publisher = await peer.publisher(String, "/chatter", matched=1)
        key, payload = await streams.after(lambda: publisher.publish(String(data="hello")))
        assert key == STREAM.of(type=1, id=2, node="nd__chatter")
        assert Metadata.decode(parse_frame(payload).metadata).sender_agent_id == 2
        other.close()


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
    (encode(adding("/t", node_type=99)), "unknown on this robot"),
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


async def test_nobody_registers_for_another(robot: RobotAgent, headset: Agent, peer: Peer) -> None:
    """A caller adds and removes nodes for itself only: its key says who it is, whatever the message says."""
    with pytest.raises(Refused, match="unity/5 cannot register or remove nodes for unity/9"):
        await headset.call("ros", ROBOT, "add_node", encode(adding("/chatter", registrant=9)))
    assert len(robot.nodes) == 0
    await headset.call("ros", ROBOT, "add_node", encode(adding("/chatter")))
    with pytest.raises(Refused, match="unity/5 cannot"):
        await headset.call("ros", ROBOT, "remove_node", encode(removing("/chatter", registrant=9)))
    assert len(robot.nodes) == 1


async def test_who_may_not_register_gets_topics_only(router: str, domain: int, peer: Peer) -> None:
    """An agent that `register_allow` does not name registers for a topic and for nothing else: nobody who may only see
    takes a service from the one that may command."""
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=ROBOT, register_allow=["block/1"]))
    service = adding("/add", "std_srvs/SetBool", node_type=NodeType.SERVICE)
    async with (
        open_robot(settings, domain_id=domain) as robot,
        macs_zenoh.join("unity", id=5, connect=[router]) as sees,
        macs_zenoh.join("unity", id=256, connect=[router]) as commands,
    ):
        await until(lambda: all((1, ROBOT) in agent.directory for agent in (sees, commands)))
        for node_type in set(NodeType) - {NodeType.SUBSCRIBER}:
            with pytest.raises(Refused, match="unity/5 may only register for topics"):
                await sees.call("ros", ROBOT, "add_node", encode(adding("/t", node_type=node_type)))
        await sees.call("ros", ROBOT, "add_node", encode(adding("/t")))
        await commands.call("ros", ROBOT, "add_node", encode(replace(service, registrant_agent_id=256)))
        assert len(robot.nodes) == 2


async def test_a_headset_that_vanishes_is_forgotten(robot: RobotAgent, router: str, peer: Peer) -> None:
    """When its presence ends, its interface nodes end."""
    async with macs_zenoh.join("unity", id=9, connect=[router]) as headset:
        await headset.call("ros", ROBOT, "add_node", encode(adding("/chatter", registrant=9)))
        await peer.sees("/chatter", subscriptions=1)
    await peer.sees("/chatter", subscriptions=0)
    assert len(robot.nodes) == 0


async def test_who_registers_and_is_not_there_is_forgotten(
    robot: RobotAgent, router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A registration of an agent that left while it was on its way, and of one that never came, ends by itself."""
    monkeypatch.setattr("bridge.ros.agent.ABSENT_S", 0.5)
    async with await Mesh.open(MeshSettings(connect=[router])) as mesh:
        key, frame = call((1, ROBOT), "add_node", (2, 9), encode(adding("/chatter", registrant=9)), Metadata(2, 9))
        await mesh.query(key, frame, timeout_s=PATIENCE_S)
        assert len(robot.nodes) == 1, "its presence may come later"
        await until(lambda: len(robot.nodes) == 0)


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


async def test_the_robot_tells_actions_qos_and_changes(
    router: str, robot: RobotAgent, headset: Agent, peer: Peer
) -> None:
    """An asker over the wire gets names, types and QoS with its request id, and every change when it follows."""
    sensor = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    await peer.publisher(String, "/scan", sensor)
    while "/scan" not in decode_data(Offered, await headset.call("ros", ROBOT, "offers")).publishers:
        await asyncio.sleep(0.02)
    asking = Metadata(request_id=9, message_manager=FunctionalityRequest.manager)
    headset.send(b'{"follow": true}', to="ros", ids=[ROBOT], metadata=asking)
    answer = await asyncio.wait_for(headset.receive(), PATIENCE_S)
    assert (answer.metadata.request_id, answer.metadata.message_manager, answer.metadata.node_name) == (9, "", "")
    offered = decode_data(Offered, answer.data)
    assert offered.publishers == {"/scan": "std_msgs/msg/String"}
    assert offered.qos == {"/scan": TopicQos("best_effort", "volatile")}
    await peer.subscription(Twist, "/cmd_vel")
    while True:
        change = await asyncio.wait_for(headset.receive(), PATIENCE_S)
        assert change.metadata.message_manager == FunctionalityRequest.manager
        if "/cmd_vel" in decode_data(Offered, change.data).subscribers:
            break


async def test_the_robot_shows_its_state(robot: RobotAgent, headset: Agent) -> None:
    """The verb and the message tell nodes, registrants, the stop and losses."""
    await headset.call("ros", ROBOT, "add_node", encode(adding("/chatter")))
    state = json.loads(await headset.call("ros", ROBOT, "status"))
    assert state["stopped"] is False
    (chatter,) = (node for node in state["nodes"] if node["role"] == "subscriber")
    assert chatter["name"] == "/chatter"
    assert chatter["type"] == "std_msgs/msg/String"
    assert chatter["registrants"] == ["unity/5"]
    assert chatter["carried"] == {"messages": 0, "bytes": 0, "age_s": None}
    headset.send(b"", to="ros", ids=[ROBOT], metadata=Metadata(request_id=0, message_manager=STATUS))
    answer = await asyncio.wait_for(headset.receive(), PATIENCE_S)
    assert json.loads(answer.data)["ros_node"] == state["ros_node"]


async def test_the_stop_is_a_verb_and_a_command(robot: RobotAgent, headset: Agent) -> None:
    """With the verb the caller knows that the robot has stopped; a command needs no registration."""
    assert json.loads(await headset.call("ros", ROBOT, "stop", b"true"))["stop"]["by"] == "unity/5"
    release = command("/emergency_stop", Bool(data=False), "std_msgs/Bool")
    headset.send(release.data, to="ros", ids=[ROBOT], metadata=release.metadata)
    await until(lambda: not robot.nodes.robot.stop.stopped)


async def test_control_is_asked_for_over_the_wire(robot: RobotAgent, headset: Agent) -> None:
    """A request for control that cannot be met is answered with the reason; nonsense too."""
    for number, data, reason in (
        (0, b'{"action": "take", "topic": "/cmd_vel"}', "nobody registered a publisher of /cmd_vel"),
        (1, b'{"action": "jump", "topic": "/cmd_vel"}', "Invalid enum value"),
        (2, b"\xff", "not valid JSON"),
    ):
        asking = Metadata(request_id=number, message_manager="RobotControl")
        headset.send(data, to="ros", ids=[ROBOT], metadata=asking)
        answer = await asyncio.wait_for(headset.receive(), PATIENCE_S)
        assert answer.metadata.request_id == number
        assert reason in json.loads(answer.data)["reason"]
