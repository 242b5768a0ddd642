"""A mesh agent uses a robot's topics and services as a headset does, with a real robot agent and real ROS nodes."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import AsyncExitStack

import pytest
from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool

import macs_zenoh
from bridge.headset import frames
from bridge.headset.frames import NodeSpec
from bridge.ros.agent import RobotAgent
from bridge.ros.interface import InterfaceNode
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings, TopicRule
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh, Sample
from macs_zenoh.protocol.keyexpr import UNICAST
from macs_zenoh.protocol.messages import NodeType
from macs_zenoh.protocol.wire import parse_frame
from tests.support.ros_peer import Peer, set_bool
from tests.support.waiting import PATIENCE_S, get, until

ROBOT = 7


def settings(router: str, **robot: object) -> Settings:
    return Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(**{"id": ROBOT, "group": 3, **robot}))  # type: ignore[arg-type]


@pytest.fixture
async def robot(router: str, domain: int) -> AsyncIterator[RobotAgent]:
    """Robot 7 in group 3."""
    async with open_robot(settings(router), domain_id=domain) as robot:
        yield robot


@pytest.fixture
async def agent(router: str, robot: RobotAgent) -> AsyncIterator[Agent]:
    """Agent 5, which knows of the robot."""
    async with macs_zenoh.join("unity", id=5, connect=[router]) as agent:
        await until(lambda: (1, ROBOT) in agent.directory, PATIENCE_S)
        yield agent


async def talk(peer: Peer, topic: str = "/chatter", text: str = "hello") -> asyncio.Task[None]:
    """Publish again and again, until cancelled."""
    publisher = await peer.publisher(String, topic)

    async def publish() -> None:
        while True:
            await peer.session.run(lambda: publisher.publish(String(data=text)))
            await asyncio.sleep(0.02)

    return asyncio.create_task(publish())


def used(robot: RobotAgent) -> list[InterfaceNode]:
    """The interface nodes that agents have on the robot; the emergency stop is there in any case."""
    return [node for node in robot.nodes if node is not robot.nodes.stop]


async def heard(subscription: macs_zenoh.TopicSubscription) -> macs_zenoh.TopicMessage:
    return await asyncio.wait_for(subscription.receive(), PATIENCE_S)


async def test_a_topic_is_received_typed_and_raw(agent: Agent, peer: Peer) -> None:
    """A message says which robot sent it, its CDR, and its value; the type is the robot's where none is said."""
    talking = await talk(peer)
    try:
        chatter = await subscribed(agent, "/chatter", robot=ROBOT)
        assert chatter.type == "std_msgs/String"
        async for message in chatter:
            assert (message.robot, message.topic, message.value) == (ROBOT, "/chatter", {"data": "hello"})
            assert message.data.startswith(bytes(serialize_message(String(data="hello"))).rstrip(b"\0"))
            break
    finally:
        talking.cancel()


async def subscribed(agent: Agent, topic: str, **choice: object) -> macs_zenoh.TopicSubscription:
    """Subscribe, once the robot has seen who publishes."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return await agent.subscribe(topic, **choice)  # type: ignore[arg-type]
        except macs_zenoh.Unreachable:
            assert time.monotonic() < deadline
            await asyncio.sleep(0.1)


async def test_a_command_is_what_a_headset_sends(robot: RobotAgent, agent: Agent, router: str, peer: Peer) -> None:
    """What is published reaches the ROS node, in the very frame of a headset, and the first message as well."""
    received = await peer.subscription(Twist, "/cmd_vel")
    await until(lambda: robot.session.node.count_subscribers("/cmd_vel") == 1)
    sent: list[bytes] = []

    def note(batch: Iterator[Sample]) -> None:
        sent.extend(bytes(payload) for _, payload in batch)

    async with await Mesh.open(MeshSettings(connect=[router])) as looking:
        looking.subscribe(UNICAST.every(type=1, block=0, id=ROBOT), note)
        value = {"linear": {"x": 0.25}}
        await agent.publish("/cmd_vel", value, robot=ROBOT, type="geometry_msgs/Twist")
        assert (await get(received, PATIENCE_S)).linear.x == 0.25
        twist = Twist()
        twist.linear.x = 0.5
        cdr = bytes(serialize_message(twist))
        drive = await agent.advertise("/cmd_vel", robot=ROBOT, type="geometry_msgs/msg/Twist")
        drive.publish(cdr)
        assert await get(received, PATIENCE_S) == twist
        spec = NodeSpec(NodeType.PUBLISHER, "/cmd_vel", "geometry_msgs/Twist")
        await until(lambda: sent and cdr in sent[-1], PATIENCE_S)
        ours, theirs = parse_frame(sent[-1]), parse_frame(frames.node_data(5, spec, cdr, [ROBOT]))
        assert (ours.header, ours.management, bytes(ours.body)) == (theirs.header, b"", bytes(theirs.body))
        assert json.loads(ours.metadata) == json.loads(theirs.metadata)
    assert not robot.nodes.drops


async def test_a_group_is_commanded(robot: RobotAgent, agent: Agent, peer: Peer) -> None:
    """A topic of all robots of a group is published to and received from by the group's number."""
    received = await peer.subscription(String, "/talk")
    await until(lambda: robot.session.node.count_subscribers("/talk") == 1)
    await agent.publish("/talk", {"data": "all"}, group=3, type="std_msgs/String")
    assert (await get(received, PATIENCE_S)).data == "all"
    talking = await talk(peer)
    try:
        chatter = await agent.subscribe("/chatter", group=3, type="std_msgs/String")
        assert (await heard(chatter)).robot == ROBOT
    finally:
        talking.cancel()


async def test_a_service_is_called_typed_and_raw(robot: RobotAgent, agent: Agent, peer: Peer) -> None:
    """A value is answered with a value, CDR with CDR; a service that is not there is said to be absent."""
    await peer.service(SetBool, "/set", set_bool, robot.session)
    request: dict[str, object] = {"data": True}
    answer = await agent.call_service("/set", request, robot=ROBOT, type="std_srvs/SetBool", timeout_s=PATIENCE_S)
    assert answer == {"success": True, "message": "set to True"}
    raw = await agent.call_service(
        "/set", bytes(serialize_message(SetBool.Request(data=False))), robot=ROBOT, timeout_s=PATIENCE_S
    )
    assert macs_zenoh.Types().deserialize(macs_zenoh.response_of("std_srvs/SetBool"), raw)["message"] == "set to False"
    many = await asyncio.gather(
        *(agent.call_service("/set", {"data": bool(i % 2)}, robot=ROBOT, timeout_s=PATIENCE_S) for i in range(20))
    )
    assert [answer["success"] for answer in many] == [bool(i % 2) for i in range(20)]
    with pytest.raises(macs_zenoh.Unreachable, match="there is no service /nothing"):
        await agent.call_service("/nothing", {}, robot=ROBOT, type="std_srvs/Empty", timeout_s=PATIENCE_S)
    with pytest.raises(macs_zenoh.Unreachable, match=r"ros/9 .* not online"):
        await agent.call_service("/set", {}, robot=9, type="std_srvs/Empty")


async def test_consumers_share_one_registration(robot: RobotAgent, agent: Agent, peer: Peer) -> None:
    """Several subscriptions of a topic in a program are one registration, which ends with the last of them."""
    talking = await talk(peer)
    try:
        first, *others = [await agent.subscribe("/chatter", robot=ROBOT, type="std_msgs/String") for _ in range(4)]
        (node,) = used(robot)
        assert node.registrants == {(2, 5)}
        for subscription in (first, *others):
            await heard(subscription)
        first.close()
        assert [message async for message in first][10:] == []
        with pytest.raises(macs_zenoh.Closed):
            await first.receive()
        await heard(others[0])
        assert used(robot) == [node]
        for subscription in others:
            subscription.close()
        await until(lambda: not used(robot), PATIENCE_S)
        again = await agent.subscribe("/chatter", robot=ROBOT, type="std_msgs/String")
        await heard(again)
    finally:
        talking.cancel()


async def test_two_agents_receive_one_stream(router: str, robot: RobotAgent, agent: Agent, peer: Peer) -> None:
    """Two agents on the mesh, one of them a robot, get the same topic, and each keeps it when the other leaves."""
    talking = await talk(peer)
    try:
        mine = await agent.subscribe("/chatter", robot=ROBOT, type="std_msgs/String")
        async with macs_zenoh.join("ros", id=8, connect=[router]) as other:
            await until(lambda: (1, ROBOT) in other.directory, PATIENCE_S)
            theirs = await other.subscribe("/chatter", robot=ROBOT, type="std_msgs/String")
            (node,) = used(robot)
            assert node.registrants == {(2, 5), (1, 8)}
            await heard(theirs)
        await until(lambda: node.registrants == {(2, 5)}, PATIENCE_S)
        for _ in range(12):  # more than was held
            await heard(mine)
    finally:
        talking.cancel()


async def test_a_robot_that_comes_back_is_asked_again(router: str, domain: int, peer: Peer) -> None:
    """What is used of a robot holds when it starts again, also when it was not there to begin with."""
    received = await peer.subscription(String, "/talk")
    talking = await talk(peer)
    async with AsyncExitStack() as stack:
        stack.callback(talking.cancel)
        agent = await stack.enter_async_context(macs_zenoh.join("unity", id=5, connect=[router]))
        chatter = await agent.subscribe("/chatter", robot=ROBOT, type="std_msgs/String", depth=1)
        drive = await agent.advertise("/talk", robot=ROBOT, type="std_msgs/String")
        for life in range(2):
            async with open_robot(settings(router), domain_id=domain) as robot:
                await until(lambda robot=robot: len(used(robot)) == 2, PATIENCE_S)  # type: ignore[misc]
                assert (await heard(chatter)).value == {"data": "hello"}

                async def reached(text: str = f"life {life}") -> bool:
                    drive.publish({"data": text})
                    await asyncio.sleep(0.05)
                    return any(received.get_nowait().data == text for _ in range(received.qsize()))

                deadline = time.monotonic() + PATIENCE_S
                while not await reached():
                    assert time.monotonic() < deadline
            await until(lambda: (1, ROBOT) not in agent.directory, PATIENCE_S)
            while chatter._waiting:
                await chatter.receive()


async def test_a_refusal_raises_with_the_robots_reason(agent: Agent, robot: RobotAgent, peer: Peer) -> None:
    """Who asks for what a robot does not let is told why at once, and nothing of it remains."""
    with pytest.raises(macs_zenoh.Refused, match="no_such_msgs"):
        await agent.subscribe("/x", robot=ROBOT, type="no_such_msgs/Thing")
    await peer.publisher(String, "/chatter")
    await until(lambda: robot.session.node.count_publishers("/chatter") == 1)
    with pytest.raises(macs_zenoh.Refused, match=r"std_msgs/msg/String.*geometry_msgs|geometry_msgs.*std_msgs"):
        await agent.advertise("/chatter", robot=ROBOT, type="geometry_msgs/Twist")
    assert used(robot) == []
    with pytest.raises(macs_zenoh.UsageError, match="of which robot"):
        await agent.subscribe("/chatter")
    with pytest.raises(macs_zenoh.OutOfRange, match="robot is 0"):
        await agent.subscribe("/chatter", robot=0, type="std_msgs/String")
    said = ""
    deadline = time.monotonic() + PATIENCE_S
    while "did you mean /chatter?" not in said:  # as soon as the robot tells of it
        assert time.monotonic() < deadline
        with pytest.raises(macs_zenoh.Unreachable, match="no robot offers it") as raised:
            await agent.subscribe("/chater", robot=ROBOT)
        said = str(raised.value)
    chatter = await agent.subscribe("/chatter", robot=ROBOT, type="std_msgs/String")
    with pytest.raises(macs_zenoh.UsageError, match="same interface node"):
        await agent.subscribe("/chatter", robot=ROBOT, type="std_msgs/Bool")
    assert chatter.refused == {}


async def test_a_command_that_is_not_taken_is_told(router: str, domain: int, peer: Peer) -> None:
    """While another has control, who commands as well hears why nothing moves."""
    rules = [TopicRule(match="/cmd_vel", exclusive=True)]
    async with (
        open_robot(settings(router, rules=rules), domain_id=domain),
        macs_zenoh.join("unity", id=5, connect=[router]) as agent,
        macs_zenoh.join("unity", id=6, connect=[router]) as other,
    ):
        await peer.subscription(Twist, "/cmd_vel")
        await until(lambda: (1, ROBOT) in agent.directory and (1, ROBOT) in other.directory, PATIENCE_S)
        await agent.publish("/cmd_vel", {}, robot=ROBOT, type="geometry_msgs/Twist")
        drive = await other.advertise("/cmd_vel", robot=ROBOT, type="geometry_msgs/Twist")
        told: list[tuple[int, str]] = []
        drive.on_refused(lambda robot, reason: told.append((robot, reason)))
        await agent.publish("/cmd_vel", {}, robot=ROBOT)
        drive.publish({})
        await until(lambda: bool(told), PATIENCE_S)
        assert told[0][0] == ROBOT
        assert "unity/5 has control" in told[0][1]


async def test_who_reads_slowly_loses_the_oldest_and_it_is_counted(agent: Agent, peer: Peer) -> None:
    """A subscription holds its depth; what goes is counted at it and at the agent, and others lose nothing by it."""
    publisher = await peer.publisher(String, "/numbers")
    slow = await agent.subscribe("/numbers", robot=ROBOT, type="std_msgs/String", depth=3)
    quick = await agent.subscribe("/numbers", robot=ROBOT, type="std_msgs/String", depth=100)
    await until(lambda: publisher.get_subscription_count() == 1)

    async def publish(text: str) -> str:
        await peer.session.run(lambda: publisher.publish(String(data=text)))
        return str((await heard(quick)).value["data"])

    first = ""
    while first != "0":  # until the robot's router knows of the subscription
        with_time = asyncio.create_task(publish("0"))
        done, _ = await asyncio.wait([with_time], timeout=0.5)
        with_time.cancel()
        first = with_time.result() if done else ""
    for number in range(1, 6):
        while await publish(str(number)) != str(number):
            pass
    assert slow.dropped == agent.drops["topic_full"] > 0
    assert [str((await heard(slow)).value["data"]) for _ in range(3)] == ["3", "4", "5"]
    assert quick.dropped == 0


async def test_all_ends_with_the_agent(router: str, robot: RobotAgent, peer: Peer) -> None:
    """An agent that leaves ends its subscriptions, publishers and calls, and robots forget them."""

    async with macs_zenoh.join("unity", id=6, connect=[router]) as agent:
        await until(lambda: (1, ROBOT) in agent.directory, PATIENCE_S)
        chatter = await agent.subscribe("/chatter", robot=ROBOT, type="std_msgs/String")
        talk = await agent.advertise("/talk", robot=ROBOT, type="std_msgs/String")
        waiting = asyncio.ensure_future(chatter.receive())
        await asyncio.sleep(0)
        assert len(used(robot)) == 2
    with pytest.raises(macs_zenoh.Closed):
        await waiting
    with pytest.raises(macs_zenoh.Closed):
        talk.publish({"data": ""})
    with pytest.raises(macs_zenoh.Closed):
        await agent.subscribe("/chatter", robot=ROBOT, type="std_msgs/String")
    assert not chatter.is_open
    await until(lambda: not used(robot), PATIENCE_S)
