"""Every kind of interface node on real processes: router, gateway, robot agent; headsets over TCP; ROS nodes here."""

from __future__ import annotations

import array
import asyncio
import contextlib
import json
import signal
import time
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from rclpy.action import ActionServer
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Empty, String
from std_srvs.srv import SetBool, Trigger

from bridge.headset.actions import SUCCEEDED
from bridge.headset.client import Headset
from macs_zenoh.errors import Refused, Unreachable
from tests.ros import unity_serializer
from tests.support.programs import ROOT, Program, ended, free_port, macs
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, first_of, until

SET = "std_srvs/SetBool"


@dataclass
class Site:
    """Everything that runs: three headsets of group 4, robot 1 of group 3."""

    gateway: Program
    robot: Program
    headsets: list[Headset]

    @property
    def headset(self) -> Headset:
        return self.headsets[0]


SETTINGS = f"""
[robot]
call_timeout_s = {PATIENCE_S}
"""
"""A busy machine may take longer for an answer than people should wait for it."""


@pytest.fixture
async def site(domain: int, count_action: Any, tmp_path: Path) -> AsyncIterator[Site]:
    settings = tmp_path / "macs.toml"
    settings.write_text(SETTINGS)
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        await stack.enter_async_context(Program("router", "-l", endpoint))
        gateway = await stack.enter_async_context(Program("gateway", "--port", "0", "-e", endpoint))
        argv = ("--id", "1", "--group", "3", "--settings", str(settings), "-e", endpoint)
        robot = Program("agent", *argv, env={"ROS_DOMAIN_ID": str(domain)})
        await robot.start()
        stack.push_async_callback(robot.stop)
        headsets = [
            await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port, group=4, reconnect=True))
            for _ in range(3)
        ]
        for headset in headsets:
            while (await headset.online()).ros_agent_ids != [1]:
                await asyncio.sleep(0.02)
        yield Site(gateway, robot, headsets)


async def offered(site: Site, name: str, kind: str) -> None:
    """Wait until the robot knows of a topic, service or action that has just been made beside it."""
    wanted = f'"{name}":"{kind}"'.encode()
    while wanted not in await site.headset.ask(1, "FunctionalityGetter"):
        await asyncio.sleep(0.05)


async def serve_set(peer: Peer, name: str) -> None:
    def answer(request: Any, response: Any) -> Any:
        response.success, response.message = request.data, "robot"
        return response

    await peer.session.run(lambda: peer.session.node.create_service(SetBool, name, answer))


@pytest.mark.parametrize("how", ["agents", "groups"])
async def test_three_headsets_get_a_camera(site: Site, peer: Peer, how: str) -> None:
    """A best-effort image of 1 MB reaches three headsets whole, registered by id or by group; a late one too."""
    where = {"agents": [1]} if how == "agents" else {"groups": [3]}
    early = [await h.subscribe("/camera", "sensor_msgs/Image", **where) for h in site.headsets[:2]]
    publisher = await peer.publisher(Image, "/camera", qos_profile_sensor_data, matched=1)
    image = Image(width=1000, height=1000, encoding="mono8", step=1000, data=array.array("B", bytes(1_000_000)))
    image.data[999_999] = 7

    async def publish() -> None:
        while True:
            publisher.publish(image)
            await asyncio.sleep(0.1)

    task = asyncio.create_task(publish())
    late = await site.headsets[2].subscribe("/camera", "sensor_msgs/Image", **where)
    for subscription in (*early, late):
        message = await asyncio.wait_for(subscription.__anext__(), PATIENCE_S)
        assert deserialize_message(message.data, Image) == image
    task.cancel()


async def test_services_both_ways(site: Site, peer: Peer) -> None:
    """Headsets call a robot's service and run one for the robot's nodes, and hear why when a call fails."""
    await serve_set(peer, "/set")
    await offered(site, "/set", "std_srvs/srv/SetBool")
    on = bytes(serialize_message(SetBool.Request(data=True)))
    answers = await asyncio.gather(*(h.call("/set", SET, 1, on, failures=True) for h in site.headsets))
    assert [deserialize_message(answer, SetBool.Response).success for answer in answers] == [True] * 3
    with pytest.raises(Unreachable, match="there is no service /none on this robot"):
        await site.headset.call("/none", SET, 1, on, failures=True)
    with pytest.raises(Refused, match="the request is no std_srvs/srv/SetBool"):
        await site.headset.call("/set", SET, 1, b"\x00\x01", failures=True)

    async def handler(request: Any) -> bytes:
        if not deserialize_message(request.data, SetBool.Request).data:
            raise Refused("not now")
        return bytes(serialize_message(SetBool.Response(success=True, message="headset")))

    await site.headset.serve("/ask", SET, handler, agents=[1])
    client = await peer.session.run(lambda: peer.session.node.create_client(SetBool, "/ask"))
    await until(client.service_is_ready)
    for data, success, text in ((True, True, "headset"), (False, False, "not now")):
        request = SetBool.Request(data=data)
        call = await peer.session.run(lambda request=request: client.call_async(request))
        await until(call.done)
        response = call.result()
        assert response.success is success
        assert text in response.message


async def test_a_headset_that_vanishes_in_a_call_ends_it(site: Site, peer: Peer) -> None:
    """The ROS caller gets its error when the headset that serves is cut off, long before the deadline."""
    asked = asyncio.Event()

    async def handler(request: Any) -> bytes:
        asked.set()
        await asyncio.sleep(60)
        return b""

    await site.headset.serve("/ask", SET, handler, agents=[1])
    client = await peer.session.run(lambda: peer.session.node.create_client(SetBool, "/ask"))
    await until(client.service_is_ready)
    call = await peer.session.run(lambda: client.call_async(SetBool.Request()))
    await asyncio.wait_for(asked.wait(), PATIENCE_S)
    await site.headset.abort()
    await until(call.done)
    assert "has left" in call.result().message


async def test_an_action_over_the_wire(site: Site, peer: Peer, count_action: Any) -> None:
    """Goal, feedback and result; and the result of a goal whose headset lost its connection meanwhile."""

    def execute(goal: Any) -> Any:
        for number in range(goal.request.to):
            goal.publish_feedback(count_action.Feedback(at=number))
        time.sleep(0.2)  # in ROS a result can overtake the feedback before it
        goal.succeed()
        return count_action.Result(reached=goal.request.to, text="done")

    server = await peer.session.run(lambda: ActionServer(peer.session.node, count_action, "/count", execute))
    await offered(site, "/count", "macs_test_msgs/action/Count")
    counting = await site.headset.action("/count", "macs_test_msgs/Count", agents=[1], buffer_size=100)
    goal = await counting.send_goal(1, bytes(serialize_message(count_action.Goal(to=3))), timeout_s=10)
    assert [deserialize_message(data, count_action.Feedback).at async for data in goal] == [0, 1, 2]
    assert (await goal.result(PATIENCE_S)).status == SUCCEEDED
    site.headset.drop_connection()
    while True:
        try:
            again = await counting.resume(1, goal.id)
            break
        except Unreachable:  # it is not back yet
            await asyncio.sleep(0.02)
    status, data = await again.result(PATIENCE_S)
    assert status == SUCCEEDED
    assert deserialize_message(data, count_action.Result).text == "done"
    where = site.headset.target
    types = str(ROOT / "tests" / "ros" / "macs_test_msgs")
    goal_of = ("headset", where, "--types", types, "goal", "/count", "macs_test_msgs/Count")
    code, out, log = await ended(*goal_of, '{"to": 2}', "--agent", "1")
    *steps, end = [json.loads(line) for line in out.splitlines()]
    assert (code, [step["feedback"]["at"] for step in steps]) == (0, [0, 1]), log
    assert (end["status"], end["result"]) == ("succeeded", {"reached": 2, "text": "done"})
    code, out, log = await ended(*goal_of, '{"too": 2}', "--agent", "1")
    assert (code, out) == (2, "")
    assert "no such field (there is: to, step_s)" in log
    await peer.session.run(server.destroy)

    status = await macs("headset", where, "ask", "RobotStatus", "--agent", "1")
    assert (status["from"], status["answer"]["stopped"]) == (1, False)
    taking = ("ask", "RobotControl", '{"action": "take", "topic": "/nothing"}', "--agent", "1")
    code, out, log = await ended("headset", where, *taking)
    assert (code, json.loads(out)["answer"]["done"]) == (1, False), log


async def test_a_robot_that_restarts_streams_on(site: Site, peer: Peer, domain: int) -> None:
    """After kill -9 of the robot agent and a new start, headsets get the topic again without doing anything."""
    subscription = await site.headset.subscribe("/chatter", "std_msgs/String", agents=[1])
    publisher = await peer.publisher(String, "/chatter", matched=1)

    published = 0

    async def publish() -> None:
        nonlocal published
        while True:
            published += 1
            publisher.publish(String(data=str(published)))
            await asyncio.sleep(0.02)

    task = asyncio.create_task(publish())
    await asyncio.wait_for(subscription.__anext__(), PATIENCE_S)
    await site.robot.stop(signal.SIGKILL)
    await site.robot.start()
    restarted = published

    async def number() -> int:
        message = await asyncio.wait_for(subscription.__anext__(), PATIENCE_S)
        return int(deserialize_message(message.data, String).data)

    while await number() < restarted:
        pass
    task.cancel()


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGKILL])
async def test_who_holds_a_service_keeps_it_when_the_robot_restarts(
    site: Site, peer: Peer, how: signal.Signals
) -> None:
    """A headset behind another gateway that was refused does not get the service by being quicker: whoever holds it
    has it after each restart, and the other one when the holder has left."""

    def served_by(name: str) -> Any:
        async def handler(request: Any) -> bytes:
            return bytes(serialize_message(SetBool.Response(success=True, message=name)))

        return handler

    client = await peer.session.run(lambda: peer.session.node.create_client(SetBool, "/ask"))

    async def who_answers() -> str:
        while True:
            await until(client.service_is_ready)
            call = await peer.session.run(lambda: client.call_async(SetBool.Request(data=True)))
            with contextlib.suppress(AssertionError):  # it went to a server that is no more
                await until(call.done, 5)
                if call.result().success:  # otherwise it says why nobody answered
                    return str(call.result().message)

    async with AsyncExitStack() as stack:
        far = await stack.enter_async_context(Program("gateway", "--port", "0", *site.robot.argv[-2:]))
        second = await stack.enter_async_context(await Headset.connect("127.0.0.1", far.port, reconnect=True))
        while (await second.online()).ros_agent_ids != [1]:
            await asyncio.sleep(0.02)
        async with await Headset.connect("127.0.0.1", site.gateway.port) as first:
            await first.serve("/ask", SET, served_by("first"), agents=[1])
            assert await who_answers() == "first"
            refused = await second.serve("/ask", SET, served_by("second"), agents=[1])
            await until(lambda: "registered by another agent" in str(refused.refusing()))
            for _ in range(3):
                await site.robot.stop(how)
                await site.robot.start()
                assert await who_answers() == "first"
        while await who_answers() != "second":
            await asyncio.sleep(0.1)


async def test_what_a_robot_offers_and_its_state_are_asked_by_a_headset(site: Site, peer: Peer) -> None:
    """Over TCP, a headset asks the robot, and its other requests go on."""
    await peer.publisher(String, "/chatter")
    await offered(site, "/chatter", "std_msgs/msg/String")
    assert b'"stopped":false' in await site.headset.ask(1, "RobotStatus")
    control = await site.headset.ask(1, "RobotControl", b'{"action": "take", "topic": "/cmd_vel"}')
    assert b"nobody registered" in control
    assert (await site.headset.online()).ros_agent_ids == [1]


async def test_the_robot_leaves_at_once(site: Site) -> None:
    """SIGINT and SIGTERM end the agent cleanly, with exit code 0, and everybody sees it leave."""
    for number in (signal.SIGTERM, signal.SIGINT):
        assert await site.robot.stop(number) == 0
        while (await site.headset.online()).ros_agent_ids:
            await asyncio.sleep(0.02)
        await site.robot.start()


async def test_existing_and_newer_headsets_read_a_latched_topic(site: Site, peer: Peer, domain: int) -> None:
    """Whenever it registers, each headset gets the last JointState once, in the form that its own serializer reads."""
    state = JointState(name=["a", "b"], position=[1.0, 2.0])
    publisher = await peer.publisher(
        JointState, "/joints", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    )
    publisher.publish(state)
    existing = await Headset.connect("127.0.0.1", site.gateway.port, extensions=0)
    async with existing:
        for headset in (site.headsets[0], existing, site.headsets[1]):
            joints = await headset.subscribe("/joints", "sensor_msgs/JointState", agents=[1])
            data = (await asyncio.wait_for(joints.__anext__(), PATIENCE_S)).data
            if headset is existing:
                assert data == unity_serializer.write(state)
            else:
                assert deserialize_message(data, JointState) == state
        for headset in (*site.headsets[:2], existing):
            (joints,) = headset.nodes
            await first_of(joints.__anext__(), lambda: publisher.publish(state))
            assert joints.dropped == 0  # type: ignore[attr-defined]


async def test_an_existing_headset_calls_and_commands_without_fields(site: Site, peer: Peer) -> None:
    """Take-off and a Trigger, as existing headsets write them, over the wire."""
    taken_off = await peer.subscription(Empty, "/takeoff")

    def answer(request: Any, response: Any) -> Any:
        response.success = True
        return response

    await peer.session.run(lambda: peer.session.node.create_service(Trigger, "/land", answer))
    await offered(site, "/land", "std_srvs/srv/Trigger")
    async with await Headset.connect("127.0.0.1", site.gateway.port, extensions=0) as existing:
        takeoff = await existing.advertise("/takeoff", "std_msgs/Empty", agents=[1])
        deadline = time.monotonic() + PATIENCE_S
        while taken_off.empty():  # what waits too long for its registration on a busy machine is not carried out
            assert time.monotonic() < deadline
            await takeoff.publish(unity_serializer.write(Empty()))
            await asyncio.sleep(0.2)
        response = await existing.call("/land", "std_srvs/Trigger", 1, unity_serializer.write(Trigger.Request()))
        assert unity_serializer.read(Trigger.Response, response).success


async def test_a_message_above_the_limit_costs_no_connection(site: Site, peer: Peer) -> None:
    """Of 33 MB nothing is sent, and the headset is told; a headset that takes less lets go of it, and of no more."""
    async with await Headset.connect("127.0.0.1", site.gateway.port, max_message_bytes=1 << 20) as modest:
        subscriptions = [
            await headset.subscribe("/cloud", "std_msgs/String", agents=[1]) for headset in (site.headset, modest)
        ]
        publisher = await peer.publisher(String, "/cloud", matched=1)

        def of(size: int) -> Callable[[], None]:
            return lambda: publisher.publish(String(data="x" * size))

        of(33 << 20)()
        assert len((await first_of(subscriptions[0].__anext__(), of(2 << 20), every_s=1.0)).data) > 2 << 20
        small = await first_of(subscriptions[1].__anext__(), of(5))
        assert deserialize_message(small.data, String).data == "x" * 5
        await until(lambda: "more than max_frame_bytes" in str(subscriptions[0].refusing()))
        assert modest.connected
        assert site.headset.connected
