"""One bad message of any kind never silences a node or the agent: every field of metadata and data is spoiled."""

from __future__ import annotations

import asyncio
import json
import random
from collections.abc import AsyncIterator
from typing import Any

import pytest
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String
from std_srvs.srv import SetBool

from bridge.ros.agent import RobotAgent
from bridge.ros.program import open_robot
from bridge.settings import RobotSettings, Settings
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import MacsError
from macs_zenoh.joining import join as join_mesh
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol.keyexpr import UNICAST
from macs_zenoh.protocol.messages import Metadata, NodeType, encode_data, node_name
from macs_zenoh.protocol.wire import encode_frame, encode_message
from tests.support.programs import free_port
from tests.support.ros_peer import Peer, adding
from tests.support.waiting import PATIENCE_S, until

ROBOT = 7
SET = "std_srvs/SetBool"

SPOILT: list[Any] = [
    None,
    "",
    "x",
    "nd__other",
    -1,
    0,
    1,
    2,
    3,
    4,
    5,
    255,
    256,
    1 << 40,
    1.5,
    True,
    [],
    {},
    [[]],
    "\x00",
]


@pytest.fixture
async def mesh(domain: int) -> AsyncIterator[tuple[RobotAgent, Agent]]:
    """Robot 7 and headset 5, an agent on the mesh."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    settings = Settings(mesh=MeshSettings(connect=[endpoint]), robot=RobotSettings(id=ROBOT))
    async with (
        await Mesh.open(MeshSettings(mode="router", listen=[endpoint])),
        open_robot(settings, domain_id=domain) as robot,
        join_mesh("unity", id=5, connect=[endpoint]) as headset,
    ):
        await until(lambda: (1, ROBOT) in headset.directory)
        yield robot, headset


NODES = {
    NodeType.SUBSCRIBER: ("/heard", "std_msgs/String"),
    NodeType.PUBLISHER: ("/said", "std_msgs/String"),
    NodeType.CLIENT: ("/set", SET),
    NodeType.SERVICE: ("/ask", SET),
}


def put(headset: Agent, metadata: bytes, data: bytes) -> None:
    """A frame as it is, with nothing that makes it right on the way."""
    key = UNICAST.of(type=1, block=ROBOT >> 8, id=ROBOT, from_type=2, from_id=5)
    headset.mesh.put(key, encode_frame(1, (ROBOT,), message=encode_message(metadata, data)))


async def test_every_spoilt_field_costs_one_message(mesh: tuple[RobotAgent, Agent], peer: Peer) -> None:
    """After each field of each kind of message was spoiled in every way, each node does its work."""
    robot, headset = mesh

    def answer(request: Any, response: Any) -> Any:
        response.success = request.data
        return response

    await peer.service(SetBool, "/set", answer, robot.session)
    heard = await peer.subscription(String, "/said")
    for kind, (name, data_type) in NODES.items():
        await headset.call("ros", ROBOT, "add_node", encode_data(adding(name, data_type, node_type=kind)))
    good = {
        NodeType.SUBSCRIBER: b"",
        NodeType.PUBLISHER: bytes(serialize_message(String(data="hi"))),
        NodeType.CLIENT: bytes(serialize_message(SetBool.Request(data=True))),
        NodeType.SERVICE: bytes(serialize_message(SetBool.Response(success=True))),
    }
    chance = random.Random(4)
    for kind, (name, data_type) in NODES.items():
        whole = json.loads(Metadata(2, 5, 3, "", kind, node_name(name), data_type).encode())
        for field in whole:
            for value in SPOILT:
                put(headset, json.dumps({**whole, field: value}).encode(), good[kind])
            put(headset, json.dumps({key: value for key, value in whole.items() if key != field}).encode(), good[kind])
            await asyncio.sleep(0)
        for metadata in (b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 5000, b"{}"):
            put(headset, metadata, good[kind])
        spoilt = [good[kind][:size] for size in range(len(good[kind]))]
        for at in range(len(good[kind])):
            byte = bytes((chance.randrange(256),))
            spoilt.append(good[kind][:at] + byte + good[kind][at + 1 :])
        for data in spoilt:
            put(headset, json.dumps(whole).encode(), data)
        await asyncio.sleep(0.01)
    await _works(robot, headset, peer, heard)


async def test_every_spoilt_registration_is_answered(mesh: tuple[RobotAgent, Agent], peer: Peer) -> None:
    """A registration with any field spoiled is done or refused, in one line, and the next one is done."""
    _, headset = mesh
    refusals: set[str] = set()
    for name, data_type in NODES.values():
        whole = json.loads(encode_data(adding(name, data_type, node_type=1)))
        for field in whole:
            for value in SPOILT:
                for verb in ("add_node", "remove_node"):
                    try:
                        await headset.call("ros", ROBOT, verb, json.dumps({**whole, field: value}).encode())
                    except MacsError as error:
                        refusals.add(str(error))
    assert not [refusal for refusal in refusals if "\n" in refusal or "internal error" in refusal]
    await headset.call("ros", ROBOT, "add_node", encode_data(adding("/fine")))


async def _works(robot: RobotAgent, headset: Agent, peer: Peer, heard: asyncio.Queue[Any]) -> None:
    """All four nodes do what they are for."""
    while not heard.empty():
        heard.get_nowait()

    def say() -> bool:
        to = Metadata(2, 5, 0, "", NodeType.PUBLISHER, "nd__said", "std_msgs/String")
        headset.send(bytes(serialize_message(String(data="still here"))), to="ros", ids=[ROBOT], metadata=to)
        return any(message.data == "still here" for message in list(heard._queue))  # type: ignore[attr-defined]

    await until(say)
    to = Metadata(2, 5, 77, "", NodeType.CLIENT, "nd__set", SET)
    headset.send(bytes(serialize_message(SetBool.Request(data=True))), to="ros", ids=[ROBOT], metadata=to)
    client = await peer.session.run(lambda: peer.session.node.create_client(SetBool, "/ask"))
    await until(client.service_is_ready)
    await asyncio.sleep(0.2)
    asked = await peer.session.run(lambda: client.call_async(SetBool.Request()))
    answered = False
    while not (answered and asked.done()):
        message = await asyncio.wait_for(headset.receive(), PATIENCE_S)
        metadata = message.metadata
        if metadata.node_type == NodeType.SERVICE:
            back = Metadata(2, 5, metadata.request_id, "", NodeType.SERVICE, "nd__ask", SET)
            data = bytes(serialize_message(SetBool.Response(success=True)))
            headset.send(data, to="ros", ids=[ROBOT], metadata=back)
            await until(asked.done)
        elif metadata.request_id == 77 and metadata.node_type == NodeType.CLIENT:
            answered = deserialize_message(message.data, SetBool.Response).success
    assert asked.result().success
    frames: asyncio.Queue[Any] = asyncio.Queue()
    headset.mesh.subscribe("macs/from/ros/7/**", lambda batch: [frames.put_nowait(sample) for sample in batch])
    publisher = await peer.publisher(String, "/heard", matched=1)
    await until(lambda: [publisher.publish(String(data="x"))] and not frames.empty())
    assert len(robot.nodes) == 4
