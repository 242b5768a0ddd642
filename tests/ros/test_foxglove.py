"""`macs foxglove`, asked by its protocol: what a robot published comes as it was, and what is asked for is done."""

from __future__ import annotations

import asyncio
import json
import re
import struct
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import aiohttp
import pytest

pytest.importorskip("foxglove", reason="needs the extra foxglove: pip install 'macs-zenoh[foxglove]'")

from geometry_msgs.msg import Twist
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool

import macs_zenoh
from bridge.foxglove.publishing import ClientTopics
from tests.support.processes import Process
from tests.support.programs import ROOT, Program, ended, macs
from tests.support.ros_peer import Peer, set_bool
from tests.support.routers import Router
from tests.support.waiting import get, until

SUBPROTOCOL = "foxglove.sdk.v1"


class Client:
    """A Foxglove client by hand."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.channels: dict[str, dict[str, Any]] = {}
        self.services: dict[str, dict[str, Any]] = {}
        self.said: list[dict[str, Any]] = []
        self.data: asyncio.Queue[tuple[int, bytes]] = asyncio.Queue()
        self.answers: asyncio.Queue[bytes] = asyncio.Queue()
        self._reading = asyncio.create_task(self._read())

    async def _read(self) -> None:
        async for message in self.socket:
            if message.type == aiohttp.WSMsgType.TEXT:
                said = json.loads(message.data)
                self.said.append(said)
                for channel in said.get("channels", []) if said["op"] == "advertise" else []:
                    self.channels[channel["topic"]] = channel
                for service in said.get("services", []) if said["op"] == "advertiseServices" else []:
                    self.services[service["name"]] = service
            elif message.data[0] == 1:
                subscription, _ = struct.unpack_from("<IQ", message.data, 1)
                self.data.put_nowait((subscription, message.data[13:]))
            elif message.data[0] == 3:
                self.answers.put_nowait(message.data)

    async def send(self, **what: Any) -> None:
        await self.socket.send_str(json.dumps(what))

    async def subscribe(self, number: int, topic: str) -> None:
        await until(lambda: topic in self.channels)
        subscription = {"id": number, "channelId": self.channels[topic]["id"]}
        await self.send(op="subscribe", subscriptions=[subscription])

    async def next(self, number: int, wanted: Callable[[bytes], bool] = lambda data: True) -> bytes:
        """The next message of a subscription that is as wanted."""
        while True:
            subscription, data = await get(self.data)
            if subscription == number and wanted(data):
                return bytes(data)


@pytest.fixture
async def site(domain: int) -> AsyncIterator[tuple[str, Client]]:
    """Robot 7, and a client of a Foxglove server on its mesh."""
    async with (
        Router() as router,
        Program("agent", "--id", "7", "-e", router.endpoint, env={"ROS_DOMAIN_ID": str(domain)}),
        Program("foxglove", "--port", "0", "-e", router.endpoint) as server,
        client_of(server) as client,
    ):
        yield router.endpoint, client


@asynccontextmanager
async def client_of(server: Program) -> AsyncIterator[Client]:
    """A client of a Foxglove server."""
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"ws://127.0.0.1:{server.port}", protocols=[SUBPROTOCOL], max_msg_size=0) as socket,
    ):
        assert socket.protocol == SUBPROTOCOL
        yield Client(socket)


COMMANDED = {"id": 5, "topic": "/7/cmd_vel", "encoding": "cdr", "schemaName": "geometry_msgs/msg/Twist"}


def command(speed: float) -> bytes:
    """What a client sends on the channel above."""
    twist = Twist()
    twist.linear.x = speed
    return b"\x01" + struct.pack("<I", 5) + bytes(serialize_message(twist))


async def test_a_topic_comes_as_it_was_published(site: tuple[str, Client], peer: Peer) -> None:
    """With its real schema and the robot's bytes; the robot is asked for it only while somebody looks."""
    endpoint, client = site
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = await peer.publisher(String, "/name", latched)
    published = bytes(serialize_message(String(data="seven")))
    publisher.publish(published)
    await until(lambda: "/7/name" in client.channels)
    channel = client.channels["/7/name"]
    assert (channel["encoding"], channel["schemaName"]) == ("cdr", "std_msgs/msg/String")
    assert channel["schemaEncoding"] == "ros2msg"
    assert "string data" in channel["schema"]
    assert publisher.get_subscription_count() == 0
    await client.subscribe(1, "/7/name")
    data = await client.next(1)
    assert data.startswith(published)
    assert deserialize_message(data, String).data == "seven"
    await client.send(op="unsubscribe", subscriptionIds=[1])
    await until(lambda: publisher.get_subscription_count() == 0)
    await client.subscribe(2, "/7/name")  # later, it is latched
    assert (await client.next(2)).startswith(published)
    del endpoint


async def test_what_is_said_of_robots_comes_as_json(site: tuple[str, Client]) -> None:
    """Who stopped a robot is on a channel of its own."""
    endpoint, client = site
    await client.subscribe(1, "/macs/status")
    await client.next(1)
    await macs("stop", "7", "--json", "-e", endpoint)
    await client.subscribe(2, "/macs/stops")
    stop = json.loads(await client.next(2, lambda data: json.loads(data)["stopped"]))
    assert (stop["robot"], stop["by"]) == (7, "operator/0")


async def test_the_graph_is_shown(site: tuple[str, Client], peer: Peer) -> None:
    """Which robot publishes and serves what, and who receives it."""
    _, client = site
    await peer.publisher(String, "/chatter")
    await peer.session.run(lambda: peer.session.node.create_service(SetBool, "/lamp", set_bool))
    await client.send(op="subscribeConnectionGraph")
    shown: dict[str, list[str]] = {}

    def shows(topic: str, ids: str) -> list[str]:
        for said in client.said:
            for each in said.get("publishedTopics", []) + said.get("subscribedTopics", []):
                shown.update({f"{each['name']} {key}": each[key] for key in each if key != "name"})
            for each in said.get("advertisedServices", []) if said["op"] == "connectionGraphUpdate" else []:
                shown[f"{each['name']} providerIds"] = each["providerIds"]
        return shown.get(f"{topic} {ids}", [])

    await client.subscribe(1, "/7/chatter")
    await until(lambda: shows("/7/chatter", "publisherIds") == ["robot 7"])
    await until(lambda: shows("/7/lamp", "providerIds") == ["robot 7"])
    (receiver,) = await until(lambda: shows("/7/chatter", "subscriberIds"))
    assert receiver.startswith("unity/")


async def test_nobody_moves_a_robot_unless_the_server_was_told_so(site: tuple[str, Client], peer: Peer) -> None:
    """Without --publish no client can: any web page on the machine is one. Nothing is registered, no service shown."""
    _, client = site
    driven = await peer.subscription(Twist, "/cmd_vel", 10)
    node = peer.session.node
    await peer.session.run(lambda: node.create_service(SetBool, "/set", set_bool))
    await until(lambda: any(said["op"] == "serverInfo" for said in client.said))
    (info,) = [said for said in client.said if said["op"] == "serverInfo"]
    assert not {"clientPublish", "services"} & set(info["capabilities"])
    await client.send(op="advertise", channels=[COMMANDED])
    for _ in range(5):
        await client.socket.send_bytes(command(0.5))
    await client.subscribe(1, "/macs/status")  # all before it has been read
    await client.next(1)
    assert driven.empty()
    assert not client.services


@pytest.fixture
async def publishing(domain: int) -> AsyncIterator[Client]:
    """The same with a server that lets clients publish to robot 7."""
    async with (
        Router() as router,
        Program("agent", "--id", "7", "-e", router.endpoint, env={"ROS_DOMAIN_ID": str(domain)}),
        Program("foxglove", "--port", "0", "-e", router.endpoint, "--publish", "--robot", "7") as server,
        client_of(server) as client,
    ):
        await until(lambda: any("may move robots" in line for line in server.log))  # another pipe than that of "ready"
        yield client


async def test_what_is_published_and_called_is_done(publishing: Client, peer: Peer) -> None:
    """A command goes to the robot that its topic names, if the server is for it, a call to its service."""
    client = publishing
    driven = await peer.subscription(Twist, "/cmd_vel", 10)
    node = peer.session.node
    await peer.session.run(lambda: node.create_service(SetBool, "/set", set_bool))
    await client.send(op="advertise", channels=[COMMANDED, {**COMMANDED, "id": 6, "topic": "/8/cmd_vel"}])

    async def arrived() -> bool:
        await client.socket.send_bytes(command(0.5))  # the first may come before ROS has found the subscription
        return not driven.empty()

    await until(arrived, every_s=0.2)
    assert driven.get_nowait().linear.x == 0.5
    await until(lambda: any("not for it" in said.get("message", "") for said in client.said))
    await until(lambda: "/7/set" in client.services)
    service = client.services["/7/set"]
    request = bytes(serialize_message(SetBool.Request(data=True)))
    await client.socket.send_bytes(b"\x02" + struct.pack("<III", service["id"], 9, 3) + b"cdr" + request)
    answer = await get(client.answers)
    assert struct.unpack_from("<II", answer, 1) == (service["id"], 9)
    (length,) = struct.unpack_from("<I", answer, 9)
    assert deserialize_message(answer[13 + length :], SetBool.Response).message == "set to True"
    assert node.count_publishers("/cmd_vel") == 1
    await client.socket.close()  # nobody drives any more, which the robot is told
    await until(lambda: node.count_publishers("/cmd_vel") == 0)


async def test_a_server_that_could_move_robots_stays_on_this_machine() -> None:
    """Nobody reaches it from elsewhere by mistake: it has no passwords."""
    code, out, errors = await ended("foxglove", "--host", "0.0.0.0", "--port", "0", "--publish")
    assert (code, out) == (2, "")
    assert "without --publish" in errors


class SlowRobot:
    """Robot 7, which answers no registration until it may, and keeps the commands that come."""

    def __init__(self, agent: macs_zenoh.Agent) -> None:
        self.may = asyncio.Event()
        self.asked = 0
        self.commands: list[bytes] = []
        agent.serve("add_node", self._add)
        agent.serve("remove_node", self._done)
        agent.on_message(lambda message: self.commands.append(bytes(message.data)))

    async def _add(self, _: Any) -> bytes:
        self.asked += 1
        await self.may.wait()
        return b"{}"

    async def _done(self, _: Any) -> bytes:
        return b"{}"


async def test_old_commands_are_not_sent() -> None:
    """What a panel publishes while its registration hangs, or while our loop does, is dropped and counted: only what
    comes afterwards is sent, in its order, over one registration."""
    async with (
        Router() as router,
        macs_zenoh.join("ros", id=7, connect=[router.endpoint]) as ros,
        macs_zenoh.join("unity", connect=[router.endpoint]) as agent,
    ):
        robot, told = SlowRobot(ros), list[tuple[str, str]]()
        topics = ClientTopics(agent, lambda robot, topic: True, lambda *what: told.append(what))
        await until(lambda: (1, 7) in agent.directory)
        topics.advertise((1, 5), "/7/cmd_vel", "geometry_msgs/msg/Twist", "cdr")
        for number in range(20):
            topics.publish((1, 5), b"\0\1\0\0old%d" % number, time.monotonic())
        await until(lambda: robot.asked)
        robot.may.set()

        def arrived() -> bool:
            topics.publish((1, 5), b"\0\1\0\0late", time.monotonic() - 0.3)
            topics.publish((1, 5), b"\0\1\0\0new", time.monotonic())
            return bool(robot.commands)

        await until(arrived, every_s=0.1)
        for number in range(50):
            topics.publish((1, 5), b"\0\1\0\0%02d" % number, time.monotonic())
            await until(lambda: robot.commands[-1].endswith(b"%02d" % number))  # noqa: B023  # more at once may be lost
        assert robot.commands[-50:] == [b"\0\1\0\0%02d" % number for number in range(50)]
        assert set(robot.commands[:-50]) == {b"\0\1\0\0new"}
        assert robot.asked == 1
        assert agent.drops["no_node"] >= 20
        assert agent.drops["too_old"] >= 1
        assert not told
        topics.close()


async def test_the_layout_is_for_the_demo_robot(domain: int) -> None:
    """Each topic and service that config/foxglove-demo.json names is one that robot 1 of the demo has."""
    layout = (ROOT / "config" / "foxglove-demo.json").read_text(encoding="utf-8")
    named = set(re.findall(r'"/1(/[a-z_/]+)', layout))
    env = {"ROS_DOMAIN_ID": str(domain)}
    demo = Process(sys.executable, "-m", "bridge.ros.demo", env=env)
    demo._heard = lambda line, *, is_log: True  # type: ignore[method-assign]
    async with (
        Router() as router,
        Program("agent", "--id", "1", "-e", router.endpoint, env=env),
        demo,
        macs_zenoh.join("unity", connect=[router.endpoint]) as agent,
    ):

        async def missing() -> bool:
            offered = json.loads(await agent.call("ros", 1, "offers", timeout_s=60))
            return bool(named - {*offered["publishers"], *offered["subscribers"], *offered["services"]})

        assert named

        async def all_there() -> bool:
            return not await missing()

        await until(all_there, every_s=0.2)
