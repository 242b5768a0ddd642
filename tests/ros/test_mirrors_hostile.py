"""Robots that are mirrored and say what is no ROS message: nothing of it comes into the graph of who mirrors them."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import msgspec
from rclpy.serialization import serialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool

import macs_zenoh
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings
from bridge.settings.mirror import MirrorRule
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings
from macs_zenoh.protocol.messages import AddNode, Metadata, NodeType, StreamData, decode_data, encode_management
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.robot_state import Offered
from macs_zenoh.protocol.wire import encode_frame, encode_message
from macs_zenoh.streams import Streams
from tests.support.local import patient
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, get, until

BAD = [b"", b'{"data": "a"}', b"\0\1\0\0", b"\0\1\0\0\2\0", b"\0\1\0\0\xff\xff\0\0A\0\0\0\0"]
"""Nothing, JSON, what ends before a String's length, and what says that it is longer."""
OFFERED = Offered(
    publishers={"/pose": "std_msgs/msg/String"}, subscribers={}, services={"/lamp": "std_srvs/srv/SetBool"}
)


class Hostile:
    """Robot 1: it registers whoever asks, publishes what it is told to, and answers calls with it."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self.registrants: dict[str, set[int]] = {}
        self.answers = iter(BAD)
        self._streams = Streams(agent)
        agent.serve("add_node", self._add)
        agent.serve("remove_node", self._remove)
        agent.serve("offers", self._offers)
        agent.on_message(self._called)

    async def _add(self, call: macs_zenoh.Call) -> bytes:
        node = decode_data(AddNode, call.data)
        self.registrants.setdefault(node.tos_name, set()).add(node.registrant_agent_id)
        return b""

    async def _remove(self, call: macs_zenoh.Call) -> bytes:
        return b""

    async def _offers(self, call: macs_zenoh.Call) -> bytes:
        return msgspec.json.encode(OFFERED)

    def say(self, data: bytes) -> None:
        metadata = Metadata(1, 1, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__pose", "std_msgs/String")
        management = encode_management(StreamData({"1": sorted(self.registrants["/pose"])}))
        message = encode_message(metadata.encode(), data)
        self._streams.publish("nd__pose", encode_frame(1, management=management, message=message))

    def _called(self, message: Message) -> None:
        said = message.metadata
        if said.node_type == NodeType.CLIENT:
            answer = Metadata(1, 1, said.request_id, "", said.node_type, said.node_name, said.data_exchange_type)
            self.agent.reply(message, next(self.answers), metadata=answer)


@contextlib.asynccontextmanager
async def hostile(router: str) -> AsyncIterator[Hostile]:
    async with macs_zenoh.join("ros", id=1, group=3, settings=patient(router)) as agent:
        yield Hostile(agent)


async def test_what_is_no_message_is_not_mirrored(router: str, domain: int, peer: Peer) -> None:
    """Of a mirrored topic come the messages, whatever is between them; what is not passed on is counted."""
    heard: asyncio.Queue[bytes] = asyncio.Queue()
    loop = asyncio.get_running_loop()

    def take(cdr: Any) -> None:
        loop.call_soon_threadsafe(heard.put_nowait, bytes(cdr))

    node = peer.session.node
    await peer.session.run(lambda: node.create_subscription(String, "/robot1/pose", take, 100, raw=True))
    rule = MirrorRule(source="ros/1", topics=["/pose"], name="/robot1{topic}")
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=2, mirror=[rule]))
    async with open_robot(settings, domain_id=domain) as own, hostile(router) as other:
        await until(lambda: other.registrants.get("/pose"), PATIENCE_S)
        first, last = [bytes(serialize_message(String(data=text))) for text in ("first", "last")]

        def comes() -> bool:
            other.say(first)
            return not heard.empty()

        await until(comes, PATIENCE_S, every_s=0.05)
        for bad in BAD:
            other.say(bad)
        other.say(last)
        while (cdr := await get(heard)) != last:
            assert cdr == first
        assert own.nodes.drops["bad_cdr"] == len(BAD)


async def test_an_answer_that_is_none_is_told_as_a_failure(router: str, domain: int, peer: Peer) -> None:
    """Who calls a mirrored service hears in any case: of an answer that cannot be one, that and why."""
    rule = MirrorRule(source="ros/1", services=["/lamp"], name="/robot1{topic}")
    settings = Settings(mesh=MeshSettings(connect=[router]), robot=RobotSettings(id=2, mirror=[rule]))
    loop = asyncio.get_running_loop()
    async with open_robot(settings, domain_id=domain) as own, hostile(router) as other:
        client = await peer.session.run(lambda: peer.session.node.create_client(SetBool, "/robot1/lamp"))
        await until(client.service_is_ready, PATIENCE_S)
        answers: asyncio.Queue[Any] = asyncio.Queue()

        def answered(future: Any) -> None:
            loop.call_soon_threadsafe(answers.put_nowait, future.result())

        good = bytes(serialize_message(SetBool.Response(success=True, message="yes")))
        other.answers = iter([*BAD, good])
        for _ in BAD:
            await peer.session.run(lambda: client.call_async(SetBool.Request(data=True)).add_done_callback(answered))
            answer = await get(answers)
            assert not answer.success
            assert "answer of ros/1" in answer.message
        await peer.session.run(lambda: client.call_async(SetBool.Request(data=True)).add_done_callback(answered))
        answer = await get(answers)
        assert (answer.success, answer.message) == (True, "yes")
        assert own.nodes.drops["bad_cdr"] == len(BAD)
