"""`macs foxglove`, asked by its protocol: what a robot published comes as it was, and what is asked for is done."""

from __future__ import annotations

import asyncio
import json
import re
import struct
import sys
from collections.abc import AsyncIterator, Callable
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
        aiohttp.ClientSession() as session,
        session.ws_connect(f"ws://127.0.0.1:{server.port}", protocols=[SUBPROTOCOL], max_msg_size=0) as socket,
    ):
        assert socket.protocol == SUBPROTOCOL
        yield router.endpoint, Client(socket)


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


async def test_what_is_published_and_called_is_done(site: tuple[str, Client], peer: Peer) -> None:
    """A command goes to the robot that its topic names, a call to its service."""
    _, client = site
    driven = await peer.subscription(Twist, "/cmd_vel", 10)
    node = peer.session.node
    await peer.session.run(lambda: node.create_service(SetBool, "/set", set_bool))
    twist = Twist()
    twist.linear.x = 0.5
    advertised = {"id": 5, "topic": "/7/cmd_vel", "encoding": "cdr", "schemaName": "geometry_msgs/msg/Twist"}
    await client.send(op="advertise", channels=[advertised])
    command = b"\x01" + struct.pack("<I", 5) + bytes(serialize_message(twist))

    async def arrived() -> bool:
        await client.socket.send_bytes(command)  # the first may come before ROS has found the subscription
        return not driven.empty()

    await until(arrived, every_s=0.2)
    assert driven.get_nowait().linear.x == 0.5
    await until(lambda: "/7/set" in client.services)
    service = client.services["/7/set"]
    request = bytes(serialize_message(SetBool.Request(data=True)))
    await client.socket.send_bytes(b"\x02" + struct.pack("<III", service["id"], 9, 3) + b"cdr" + request)
    answer = await get(client.answers)
    assert struct.unpack_from("<II", answer, 1) == (service["id"], 9)
    (length,) = struct.unpack_from("<I", answer, 9)
    assert deserialize_message(answer[13 + length :], SetBool.Response).message == "set to True"


async def test_a_server_that_could_move_robots_stays_on_this_machine() -> None:
    """Nobody reaches it from elsewhere by mistake: it has no passwords."""
    code, out, errors = await ended("foxglove", "--host", "0.0.0.0", "--port", "0")
    assert (code, out) == (2, "")
    assert "--view-only" in errors


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
