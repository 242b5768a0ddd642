"""The gateway over real sockets: what agents get from it, and what they cannot do to it or to each other."""

from __future__ import annotations

import asyncio
import itertools
import json
import math
import struct
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager

import pytest

import macs_zenoh
from bridge.headset.client import Headset
from macs_zenoh.errors import ConfigError
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.messages import (
    AddNode,
    AgentsGone,
    Metadata,
    NodeType,
    StreamData,
    decode_data,
    encode_management,
)
from macs_zenoh.protocol.wire import encode_frame, encode_message, split_message
from macs_zenoh.streams import Streams
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.sockets import socket
from tests.support.waiting import PATIENCE_S, until

METADATA = Metadata(message_manager="Greeting").encode()


BAD_FRAMES = {
    "management data that is no JSON": encode_frame(management=b"not json"),
    "management data that is no object": encode_frame(management=b"[1]"),
    "no manager": encode_frame(management=b'{"hello":1}'),
    "unknown manager": encode_frame(management=b'{"messageManager":"os.system"}'),
    "wrong type of a field": encode_frame(
        management=b'{"messageManager":"RosAgentNodeRegistrationForwarder","nodeType":"x"}'
    ),
    "kicking another agent": encode_frame(management=b'{"messageManager":"UnityAgentclientRemover","agentId":77}'),
    "a message of no bytes": encode_frame(2, (1,), message=b""),
    "metadata of no bytes": encode_frame(2, (1,), message=encode_message(b"", b"data")),
    "metadata that is no JSON": encode_frame(2, (1,), message=encode_message(b"\xff\x00", b"data")),
    "inner sizes that lie": encode_frame(2, (1,), message=struct.pack("<I", 5) + b"{}" + bytes(20)),
    "a headset sending topic data": encode_frame(
        management=b'{"messageManager":"RosAgentSubscriberDataForwarder","destAgents":{"2":[1]}}',
        message=encode_message(METADATA, b"x"),
    ),
    "nobody to send to": encode_frame(2, message=encode_message(METADATA, b"x")),
    "nested beyond reason": encode_frame(management=b'{"a":' + b"[" * 20000),
}


@pytest.mark.parametrize("name", BAD_FRAMES)
async def test_a_bad_frame_costs_that_frame(name: str, start_gateway: StartGateway, connect: Connect) -> None:
    """After a bad frame the connection goes on, it is counted, and a neighbour has seen nothing of it."""
    gateway = await start_gateway()
    neighbour = await connect(gateway)
    async with socket(gateway) as agent:
        agent.configure()
        agent.writer.write(BAD_FRAMES[name])
        good = encode_frame(2, (neighbour.id,), message=encode_message(METADATA, b"good"))
        agent.writer.write(good)
        message = await neighbour.receive(PATIENCE_S)
        assert bytes(message.data) == b"good"
        assert (await agent.online())[1] == [neighbour.id, agent.id]
        connection = gateway.agents.find(2, agent.id)
        assert sum(connection.all_drops().values()) >= 1
    assert neighbour.connected


async def test_a_frame_too_large_costs_that_connection(start_gateway: StartGateway, connect: Connect) -> None:
    """A header that declares 4 GiB closes its connection with FIN at once, and no other."""
    gateway = await start_gateway()
    neighbour = await connect(gateway)
    async with socket(gateway) as agent:
        agent.configure()
        agent.writer.write(encode_frame(management=b'{"messageManager":"HeartbeatHandler"}'))
        agent.writer.write(struct.pack("<B30xII", 2, 0, 0xFFFFFFFF))
        with pytest.raises(ConnectionError):
            await agent.message()
    await until(lambda: gateway.drops["FrameTooLarge"] == 1)
    assert (await neighbour.online()).unity_agent_ids == [neighbour.id]


async def test_frames_before_the_configuration_are_kept(start_gateway: StartGateway, connect: Connect) -> None:
    """What a headset sends before its configuration reply is done after it, with its true sender."""
    gateway = await start_gateway()
    neighbour = await connect(gateway)
    async with socket(gateway) as agent:
        lie = Metadata(sender_agent_type=2, sender_agent_id=0, message_manager="Greeting").encode()
        agent.writer.write(encode_frame(2, (neighbour.id,), message=encode_message(lie, b"early")))
        agent.configure()
        message = await neighbour.receive(PATIENCE_S)
        assert (bytes(message.data), message.metadata.sender_agent_id) == (b"early", agent.id)


async def test_nothing_comes_before_the_first_message(start_gateway: StartGateway, connect: Connect) -> None:
    """A connection that has not answered its configuration gets no broadcast, and is not online."""
    gateway = await start_gateway()
    talker = await connect(gateway)
    async with socket(gateway) as silent, socket(gateway) as listener:
        listener.configure()
        await listener.online()
        await talker.send(b"to all", to=0, manager="Greeting")
        metadata, body = await listener.message()
        assert (metadata.message_manager, body) == ("Greeting", b"to all")
        assert (await listener.online())[1] == sorted([talker.id, listener.id])
        silent.configure()
        await silent.online()  # the next message it sees is the answer to its own question


async def test_silence_ends_a_connection(start_gateway: StartGateway, connect: Connect) -> None:
    """Who does not answer the handshake, or is silent afterwards, is disconnected; the others are told at once."""
    gateway = await start_gateway(handshake_timeout_s=1.0, idle_timeout_s=2.0)
    async with AsyncExitStack() as stack:
        silent = await stack.enter_async_context(socket(gateway))
        silent.configure()
        watcher = await stack.enter_async_context(socket(gateway))
        watcher.configure()
        heartbeat = encode_frame(management=b'{"messageManager":"HeartbeatHandler"}')
        beating = asyncio.create_task(_repeat(watcher.writer, heartbeat))
        mute = await stack.enter_async_context(socket(gateway))
        with pytest.raises(ConnectionError):
            await mute.message()
        metadata, body = await watcher.message()
        beating.cancel()
        assert metadata.message_manager == AgentsGone.manager
        assert json.loads(body) == {"agents": [{"agent_type": 2, "agent_id": silent.id}]}


async def _repeat(writer: asyncio.StreamWriter, data: bytes) -> None:
    while True:
        writer.write(data)
        await asyncio.sleep(0.1)


async def test_ids_are_used_again_last(start_gateway: StartGateway, connect: Connect) -> None:
    """Ids go from 1 up; that of an agent that left is not the next to be given: answers to it may be on their way."""
    gateway = await start_gateway()
    first, second = await connect(gateway), await connect(gateway)
    assert [first.id, second.id] == [1, 2]
    await first.close()
    while (await second.online()).unity_agent_ids != [2]:
        await asyncio.sleep(0.01)
    assert (await connect(gateway)).id == 3


async def test_a_block_has_one_gateway(start_gateway: StartGateway) -> None:
    """A second gateway on a leased block is refused with a clear error; without a wish it takes the next one."""
    assert (await start_gateway(block=3)).blocks == [3]
    with pytest.raises(ConfigError, match="block 3 is another gateway's"):
        await start_gateway(block=3)
    assert (await start_gateway()).blocks == [0]


async def test_two_gateways_at_once_take_two_blocks(start_gateway: StartGateway) -> None:
    """Gateways that start in the same moment do not share a block."""
    gateways = await asyncio.gather(*(start_gateway() for _ in range(4)))
    assert sorted(gateway.blocks[0] for gateway in gateways) == [0, 1, 2, 3]


async def test_an_existing_robot_program_is_reached(start_gateway: StartGateway, connect: Connect) -> None:
    """A robot over TCP gets registrations and commands of headsets on another gateway, and its topic data arrives."""
    gateway, other = await start_gateway(), await start_gateway()
    headset = await connect(other)
    async with socket(gateway) as robot:
        robot.configure(agent_type=1)
        while robot.id not in (await headset.online()).ros_agent_ids:
            await asyncio.sleep(0.01)
        subscription = await headset.subscribe("/chatter", "std_msgs/String", agents=[robot.id])
        metadata, body = await robot.message()
        node = decode_data(AddNode, body)
        assert metadata.message_manager == AddNode.manager
        assert (node.registrant_agent_id, node.tos_name) == (headset.id, "/chatter")
        data = Metadata(1, robot.id, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__chatter", "std_msgs/String")
        management = encode_management(StreamData({"2": [headset.id]}))
        frame = encode_frame(1, management=management, message=encode_message(data.encode(), b"topic data"))
        robot.writer.write(frame)
        message = await asyncio.wait_for(subscription.__anext__(), PATIENCE_S)
        assert bytes(message.data) == b"topic data"


async def test_registrations_reach_robots_that_come_later(
    router: str, start_gateway: StartGateway, connect: Connect
) -> None:
    """A robot that joins a registered group, or comes back, is told what headsets want of it."""
    gateway = await start_gateway()
    headset = await connect(gateway)
    await headset.subscribe("/pose", "geometry_msgs/Pose", groups=[5])
    await headset.subscribe("/scan", "sensor_msgs/LaserScan", agents=[9])
    for _ in range(2):
        wanted: asyncio.Queue[AddNode] = asyncio.Queue()

        async def add(call: macs_zenoh.Call, wanted: asyncio.Queue[AddNode] = wanted) -> bytes:
            wanted.put_nowait(decode_data(AddNode, call.data))
            return b""

        async with macs_zenoh.join("ros", id=9, group=5, settings=patient(router)) as robot:
            robot.serve("add_node", add)
            topics = {(await asyncio.wait_for(wanted.get(), PATIENCE_S)).tos_name for _ in range(2)}
            assert topics == {"/pose", "/scan"}


@asynccontextmanager
async def camera(router: str, *watching: Headset) -> AsyncIterator[Callable[[], Awaitable[None]]]:
    """A robot's, whose pictures these headsets want. What is given puts the next picture, and waits until the first of
    them has it, with nothing left out before it."""
    metadata = Metadata(1, 1, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__image", "sensor_msgs/Image").encode()
    management = encode_management(StreamData({"2": [headset.id for headset in watching]}))

    async def add(call: macs_zenoh.Call) -> bytes:
        return b""

    async with macs_zenoh.join("ros", id=1, settings=patient(router)) as robot:
        robot.serve("add_node", add)
        streams, numbers = Streams(robot), itertools.count(1)
        images, *_ = [await each.subscribe("/image", "sensor_msgs/Image", agents=[1]) for each in watching]

        def put(number: int) -> None:
            message = encode_message(metadata, number.to_bytes(4, "little") + bytes(50_000))
            streams.publish("nd__image", encode_frame(1, management=management, message=message))

        async def came() -> int:
            message = await asyncio.wait_for(images.__anext__(), PATIENCE_S)
            return int.from_bytes(message.data[:4], "little")

        async def show() -> None:
            put(number := next(numbers))
            while (found := await came()) == 0:
                pass
            assert found == number

        first = asyncio.create_task(came())
        while not first.done():  # until the registration is there, nobody listens
            put(0)
            await asyncio.wait([first], timeout=0.1)
        yield show


async def test_a_stalled_headset_loses_by_itself(router: str, start_gateway: StartGateway, connect: Connect) -> None:
    """Of what a headset that stops reading does not take the oldest is dropped and counted; its neighbour gets
    everything in order."""
    gateway = await start_gateway()
    neighbour, stalled = await connect(gateway), await connect(gateway)
    stalled.pause()
    async with camera(router, neighbour, stalled) as show:
        connection = gateway.agents.find(2, stalled.id)
        while connection.all_drops()["node_full_oldest"] < 10:
            await show()
        assert connection.all_drops().keys() == {"node_full_oldest"}
        assert not gateway.agents.find(2, neighbour.id).all_drops()


async def test_a_stalled_headset_is_let_go(router: str, start_gateway: StartGateway, connect: Connect) -> None:
    """A headset that stops reading is disconnected after its time, and not before; its neighbour goes on."""
    gateway = await start_gateway(write_timeout_s=0.5)
    neighbour, stalled = await connect(gateway), await connect(gateway)
    stalled.pause()
    async with camera(router, neighbour, stalled) as show:
        connection = gateway.agents.find(2, stalled.id)
        while connection._writer.paused_at is None:
            await show()
        paused_at = connection._writer.paused_at
        while gateway.agents.find(2, stalled.id) is not None:
            await show()
        assert time.monotonic() - paused_at >= 0.5
        assert (await neighbour.online()).unity_agent_ids == [neighbour.id]
        await show()


async def test_who_leaves_without_taking_what_waits_is_gone_in_time(
    start_gateway: StartGateway, connect: Connect
) -> None:
    """A headset that has stopped reading goes silent before its outbox is full: what is still to be written keeps
    neither its id nor its slot."""
    gateway = await start_gateway(write_timeout_s=0.5, idle_timeout_s=3.0)
    neighbour, frozen = await connect(gateway), await connect(gateway)
    await until(lambda: gateway.agents.find(2, frozen.id))
    connection = gateway.agents.find(2, frozen.id)
    frozen.pause()
    message = encode_frame(2, (frozen.id,), message=encode_message(METADATA, bytes(50_000)))
    while not connection._transport.get_write_buffer_size():
        await neighbour.send_frame(message)
        await asyncio.sleep(0.005)
    assert connection._writer.paused_at is None
    connection.close("tried")
    await until(lambda: gateway.agents.find(2, frozen.id) is None)


async def test_who_drives_is_not_held_for_what_else_he_sends(
    router: str, start_gateway: StartGateway, connect: Connect
) -> None:
    """A headset that talks to one that does not read is read from more slowly, but not while it drives a robot: its
    stop would wait behind that."""
    gateway = await start_gateway(outbox_bytes=4 << 20, write_timeout_s=120.0)
    sender, slow = await connect(gateway), await connect(gateway)
    slow.pause()
    await until(lambda: gateway.agents.find(2, sender.id) and gateway.agents.find(2, slow.id))
    connection = gateway.agents.find(2, sender.id)
    mail = encode_frame(2, (slow.id,), message=encode_message(METADATA, bytes(1_000_000)))
    driving = Metadata(node_type=2, node_name="nd__cmd_vel", data_exchange_type="geometry_msgs/Twist").encode()
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as robot:
        await until(lambda: (1, 7) in gateway.directory)
        command = encode_frame(1, (robot.id,), message=encode_message(driving, b"on"))
        receiver = gateway.agents.find(2, slow.id)
        while receiver.all_drops()["outbox_full"] < 3:
            await sender.send_frame(command + mail)
            assert not receiver.backpressure.holds
        connection.drove_at = -math.inf

        async def talk() -> None:
            while True:  # until it is held, maybe in the middle of a frame
                await sender.send_frame(mail)

        talking = asyncio.create_task(talk())
        await until(lambda: receiver.backpressure.holds)
        talking.cancel()


async def test_encoding_of_the_first_message(start_gateway: StartGateway) -> None:
    """The welcome carries the connection's number as request id, and the id in its data, as agents expect."""
    gateway = await start_gateway()
    reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port)
    messages = MessageDecoder().feed(await asyncio.wait_for(reader.read(4096), PATIENCE_S))
    metadata, body = split_message(messages[0])
    assert json.loads(metadata) == {
        "senderAgentType": None,
        "senderAgentId": None,
        "requestId": 1,
        "messageManager": "AgentConfigurer",
        "nodeType": 0,
        "nodeName": "",
        "dataExchangeType": "",
    }
    assert json.loads(bytes(body)) == {"agentId": 1}
    writer.close()


async def test_the_order_is_kept_between_ids_groups_and_all(start_gateway: StartGateway, connect: Connect) -> None:
    """What one headset sends by id, by group and to everybody arrives on another gateway in the order it was sent."""
    sender = await connect(await start_gateway())
    receiver = await connect(await start_gateway(), group=6)
    while receiver.id not in (await sender.online()).unity_agent_ids:
        await asyncio.sleep(0.01)
    ways: list[dict[str, object]] = [{"to": 2, "ids": [receiver.id]}, {"to": 2, "groups": [6]}, {"to": 0}]
    for number in range(300):
        await sender.send(str(number).encode(), manager="Greeting", **ways[number % 3])  # type: ignore[arg-type]
    received = [int(bytes((await receiver.receive(PATIENCE_S)).data)) for _ in range(300)]
    assert received == list(range(300))
