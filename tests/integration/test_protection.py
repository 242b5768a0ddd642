"""What the gateway keeps from the existing programs because it would harm them."""

from __future__ import annotations

import asyncio
import json

import pytest

from macs_zenoh.messages import (
    AddNode,
    Metadata,
    NodeType,
    Registration,
    RemoveNode,
    StreamData,
    encode_data,
    encode_management,
)
from macs_zenoh.wire import encode_frame, encode_message
from tests.integration.conftest import Connect, StartGateway, until
from tests.integration.test_gateway import Socket, socket


def topic_data(robot: Socket, receivers: list[int], text: bytes) -> bytes:
    """A frame of an existing robot's topic /chatter."""
    metadata = Metadata(1, robot.id, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__chatter", "std_msgs/String")
    management = encode_management(StreamData({"2": receivers}))
    return encode_frame(1, management=management, message=encode_message(metadata.encode(), text))


async def test_topic_data_for_a_node_of_another_type(start_gateway: StartGateway, connect: Connect) -> None:
    """A headset that publishes to a topic gets no topic data under that node's name: it would go deaf for good."""
    gateway = await start_gateway()
    subscriber, publisher = await connect(gateway), await connect(gateway)
    async with socket(gateway) as robot:
        robot.configure(agent_type=1)
        await until(lambda: (1, robot.id) in gateway.directory)
        subscription = await subscriber.subscribe("/chatter", "std_msgs/String", agents=[robot.id])
        await robot.message()
        await publisher.advertise("/chatter", "std_msgs/String", agents=[robot.id])
        await robot.message()
        robot.writer.write(topic_data(robot, [publisher.id, subscriber.id], b"text"))
        assert bytes((await asyncio.wait_for(subscription.__anext__(), 5)).data) == b"text"
        connection = gateway.agents.find(2, publisher.id)
        assert connection.all_drops()["wrong_node_type"] == 1


def registration(headset: Socket, robots: list[int], node: AddNode | RemoveNode) -> bytes:
    """A headset's registration on robots, or the end of it."""
    registration = Registration(headset.id, node.node_type, node.node_name, robots)
    metadata = Metadata(2, headset.id, message_manager=node.manager).encode()
    message = encode_message(metadata, encode_data(node))
    return encode_frame(management=encode_management(registration), message=message)


async def test_a_robot_program_is_told_once(start_gateway: StartGateway) -> None:
    """An existing robot hears of a registration once, however often it is repeated, and again after it was undone."""
    gateway = await start_gateway()
    async with socket(gateway) as robot, socket(gateway) as headset:
        robot.configure(agent_type=1)
        headset.configure()
        await until(lambda: (1, robot.id) in gateway.directory)
        adding = AddNode(2, headset.id, 1, "nd__chatter", "/chatter", "std_msgs/String")
        removing = RemoveNode(2, headset.id, 1, "nd__chatter")
        for _ in range(2):
            for robots in ([robot.id], [77], [robot.id, 77], []):
                headset.writer.write(registration(headset, robots, adding))
                await headset.online()
            headset.writer.write(registration(headset, [robot.id, 77], removing))
            assert (await robot.message())[0].message_manager == AddNode.manager
            assert (await robot.message())[0].message_manager == RemoveNode.manager


async def test_a_short_silence_is_noticed(start_gateway: StartGateway) -> None:
    """An agent that is silent from its configuration on is gone after the time for silence, not for the handshake."""
    gateway = await start_gateway(silence_s=0.3, handshake_s=60.0)
    async with socket(gateway) as agent:
        agent.configure()
        with pytest.raises(ConnectionError):
            await agent.message()


async def test_messages_of_an_unknown_node_go_through(start_gateway: StartGateway, connect: Connect) -> None:
    """A message under the name of a node that the headset has not registered is delivered, as it always was."""
    gateway = await start_gateway()
    listener, talker = await connect(gateway), await connect(gateway)
    async with socket(gateway) as robot:
        robot.configure(agent_type=1)
        metadata = Metadata(1, robot.id, 0, "", NodeType.CLIENT, "nd__set", "std_srvs/SetBool").encode()
        robot.writer.write(encode_frame(2, (listener.id,), message=encode_message(metadata, b"answer")))
        await talker.send(json.dumps({"after": True}).encode(), ids=[listener.id], manager="Greeting")
        heard = [await listener.receive(5), await listener.receive(5)]
        assert sorted(bytes(message.data) for message in heard) == [b"answer", b'{"after": true}']
