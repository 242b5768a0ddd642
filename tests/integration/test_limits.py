"""What agents may cost a gateway, each limit reached for real."""

from __future__ import annotations

import asyncio
import resource
import socket
import struct
from contextlib import AsyncExitStack, suppress

import pytest

import macs_zenoh
from bridge.headset import frames
from bridge.headset.client import Headset
from bridge.headset.frames import NodeSpec, registration
from macs_zenoh.errors import Refused, Unreachable
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.messages import (
    Configuration,
    Metadata,
    NodeRefused,
    NodeType,
    StreamData,
    Welcome,
    decode_data,
    encode_management,
)
from macs_zenoh.protocol.wire import encode_frame, encode_message, split_message
from macs_zenoh.streams import Streams
from tests.support.gateways import answers, memory_bytes, site
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.waiting import PATIENCE_S, until

CONFIGURATION = encode_frame(
    management=b'{"agentType":2,"agentId":2,"groupId":0,"requestId":1,"messageManager":"AgentclientConfigurer"}'
)
GREETING = Metadata(message_manager="Greeting").encode()


async def test_declared_sizes_cost_nothing() -> None:
    """Two hundred headers that declare 4 GiB or just below the limit are refused or wait, at no cost in memory."""
    async with site() as (_, gateway), await Headset.connect("127.0.0.1", gateway.port) as neighbour:
        before = memory_bytes(gateway.pid)
        connections = [await asyncio.open_connection("127.0.0.1", gateway.port) for _ in range(200)]
        for number, (_, writer) in enumerate(connections):
            declared = 0xFFFFFFFF if number % 2 else (32 << 20) - 39
            writer.write(struct.pack("<B30xII", 2, 0, declared) + bytes(10))
        for reader, _ in connections[1::2]:
            assert await asyncio.wait_for(reader.read(), PATIENCE_S)  # the greeting, then FIN
        await answers(neighbour)
        assert memory_bytes(gateway.pid) - before < 48 << 20
        for _, writer in connections:
            writer.close()


async def test_a_stalled_headset_costs_its_limit() -> None:
    """While 200 MB are sent towards a headset that does not read, memory grows by its limit; a neighbour hears all."""
    async with AsyncExitStack() as stack:
        endpoint, gateway = await stack.enter_async_context(site())
        neighbour = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        stalled = socket.create_connection(("127.0.0.1", gateway.port))
        stack.callback(stalled.close)
        sender = await stack.enter_async_context(macs_zenoh.join("ros", id=1, settings=patient(endpoint)))

        async def accept(call: macs_zenoh.Call) -> bytes:
            return b""

        sender.serve("add_node", accept)
        images = await neighbour.subscribe("/image", "sensor_msgs/Image", agents=[1], buffer_size=1000)
        configuration = (
            b'{"agentType":2,"agentId":2,"groupId":0,"requestId":1,"messageManager":"AgentclientConfigurer"}'
        )
        registration = (
            b'{"messageManager":"RosAgentNodeRegistrationForwarder","registrantAgentId":2,"registrarAgentIds":[1],'
            b'"registrarGroupIds":[],"nodeType":1,"nodeName":"nd__image","tosName":"/image","dataExchangeType":"x/Y"}'
        )
        node = (
            b'{"registrantAgentType":2,"registrantAgentId":2,"nodeType":1,"nodeName":"nd__image","tosName":"/image",'
            b'"dataExchangeType":"x/Y","bufferSize":1000,"dropNew":false,"isLatched":false}'
        )
        adder = Metadata(2, 2, message_manager="InterfaceNodeAdder").encode()
        stalled.sendall(encode_frame(management=configuration))
        stalled.sendall(encode_frame(management=registration, message=encode_message(adder, node)))
        metadata = Metadata(1, 1, 0, StreamData.manager, NodeType.SUBSCRIBER, "nd__image", "x/Y").encode()
        management = encode_management(StreamData({"2": [1, 2]}))
        image = encode_frame(1, management=management, message=encode_message(metadata, bytes(200_000)))
        before = memory_bytes(gateway.pid)
        arrived = 0
        while arrived < 1000:
            Streams(sender).publish("nd__image", image)
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(images.__anext__(), 0.2)
                arrived += 1
        assert memory_bytes(gateway.pid) - before < (8 + 16) << 20


async def test_large_frames_leave_nothing() -> None:
    """After frames of 30 MiB, passed on and refused, the gateway has about the memory that it had before them."""
    async with site() as (_, gateway), await Headset.connect("127.0.0.1", gateway.port) as headset:
        await answers(headset)
        before = memory_bytes(gateway.pid)
        connections = [await asyncio.open_connection("127.0.0.1", gateway.port) for _ in range(3)]
        for size in (30 << 20, 29 << 20, 31 << 20):
            for to in (bytes(4), b"{}"):  # metadata of nothing is refused
                body = struct.pack("<I", len(to)) + to + struct.pack("<I", size) + bytes(size)
                for _, writer in connections:
                    writer.write(CONFIGURATION + struct.pack("<BH28xII", 2, headset.id, 0, len(body)) + body)
                    await writer.drain()
        for _, writer in connections:
            writer.close()
        # they have left when all that they sent has been read, and the answer comes behind what went to this headset
        while (await headset.online(2 * PATIENCE_S)).unity_agent_ids != [headset.id]:
            await asyncio.sleep(0.1)
        await until(lambda: memory_bytes(gateway.pid) - before <= 80 << 20, every_s=0.1)


async def test_silent_connections_are_closed(start_gateway: StartGateway) -> None:
    """Five hundred connections that say nothing are closed by the handshake limit, and leave nothing behind."""
    gateway = await start_gateway(handshake_timeout_s=1.0)
    await gateway._leases.take(2)  # who waits for an id is not silent, and is sent away without a word
    connections = [await asyncio.open_connection("127.0.0.1", gateway.port) for _ in range(500)]
    for reader, writer in connections:
        assert await asyncio.wait_for(reader.read(), PATIENCE_S)  # the greeting, then FIN
        writer.close()
    await until(lambda: len(gateway.agents) == 0)


async def test_connections_are_limited(start_gateway: StartGateway, connect: Connect) -> None:
    """Connections beyond the limits, and from addresses that are not allowed, are refused and counted."""
    gateway = await start_gateway(max_connections_per_address=2)
    first = await connect(gateway)
    await connect(gateway)
    with pytest.raises(Unreachable):
        await connect(gateway)
    assert gateway.drops["too_many_from_address"] == 1
    await first.close()
    await until(lambda: len(gateway.agents) == 1)
    await connect(gateway)
    closed = await start_gateway(allow=["192.168.7.0/24"])
    with pytest.raises(Unreachable):
        await connect(closed)
    assert closed.drops["address_not_allowed"] == 1
    assert (await start_gateway(allow=["127.0.0.0/8"])).drops == {}


async def test_one_address_does_not_take_all_ids(start_gateway: StartGateway) -> None:
    """Where a gateway has only so many, somebody from elsewhere gets one; who has taken most is refused and counted,
    until he gives one back."""
    gateway = await start_gateway(blocks=[3])
    most, taken = 192, []

    async def connected(host: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter] | None:
        reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port, local_addr=(host, 0))
        decoder = MessageDecoder()
        with suppress(ConnectionError):
            while data := await asyncio.wait_for(reader.read(4096), PATIENCE_S):
                if messages := decoder.feed(data):
                    welcome = decode_data(Welcome, split_message(messages[0])[1])
                    writer.write(frames.configuration(welcome.agent_id, 0, 1, 0, None))
                    await until(lambda own=welcome.agent_id: gateway.agents.find(2, own) or reader.at_eof())
                    if not reader.at_eof():
                        return reader, writer
        writer.close()
        return None

    for _ in range(most):
        taken.append(await connected("127.0.0.1"))
    assert all(taken)
    assert await connected("127.0.0.1") is None
    assert gateway.drops["too_many_ids"] == 1
    elsewhere = await connected("127.0.0.2")
    assert elsewhere is not None
    one = taken.pop()
    assert one is not None
    one[1].close()
    await until(lambda: len(gateway.agents) == most)
    taken.append(await connected("127.0.0.1"))
    assert taken[-1] is not None
    for each in (*taken, elsewhere):
        assert each is not None
        each[1].close()


async def test_all_of_an_address_come_back_though_it_has_all_ids_that_it_may(
    start_gateway: StartGateway, connect: Connect
) -> None:
    """A hall behind one address loses its Wi-Fi for a moment: each needs another id until it has shown who it was."""
    gateway = await start_gateway(blocks=[3])
    headsets = [await connect(gateway, reconnect=True) for _ in range(192)]
    ids = [headset.id for headset in headsets]
    await until(lambda: all(headset._session and headset._session.secret for headset in headsets))
    for headset in headsets:
        headset.drop_connection()
    await until(lambda: not any(headset.connected for headset in headsets))
    await until(lambda: all(headset.connected for headset in headsets))
    assert [headset.id for headset in headsets] == ids
    assert len(gateway.agents) == 192
    late = await connect(gateway)
    await until(lambda: not late.connected)
    assert len(gateway.agents) == 192


async def test_a_rate_is_kept(start_gateway: StartGateway, connect: Connect) -> None:
    """Beyond its rate a connection's messages and questions are dropped and counted; the connection stays."""
    gateway = await start_gateway(max_frames_per_s=20)
    sender, receiver = await connect(gateway), await connect(gateway)
    for number in range(100):
        await sender.send(str(number).encode(), to=2, ids=[receiver.id], manager="Greeting")
    while True:
        with suppress(Unreachable):
            await sender.online(timeout_s=0.5)
            break
    await sender.close()
    await until(lambda: gateway.drops["TooFast"] >= 50)
    assert bytes((await receiver.receive(PATIENCE_S)).data) == b"0"


async def test_descriptors_run_out() -> None:
    """A gateway without a free file descriptor goes on for those who are connected, and accepts again later."""
    async with AsyncExitStack() as stack:
        _, gateway = await stack.enter_async_context(site())
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        _, hard = resource.prlimit(gateway.pid, resource.RLIMIT_NOFILE)
        resource.prlimit(gateway.pid, resource.RLIMIT_NOFILE, (64, hard))
        crowd = [socket.create_connection(("127.0.0.1", gateway.port)) for _ in range(100)]
        await answers(headset)
        for connection in crowd:
            connection.close()
        await answers(headset)

        async def accepted() -> Headset:
            while True:
                with suppress(Unreachable, OSError):
                    return await Headset.connect("127.0.0.1", gateway.port)
                await asyncio.sleep(0.05)

        late = await stack.enter_async_context(await asyncio.wait_for(accepted(), PATIENCE_S))
        await answers(late)


async def test_a_refusal_is_told(router: str, start_gateway: StartGateway, caplog: pytest.LogCaptureFixture) -> None:
    """A headset whose registration a robot refuses is told why, by a management message of its own."""
    gateway = await start_gateway()

    async def refuse(call: macs_zenoh.Call) -> bytes:
        raise Refused("no such type here")

    async with macs_zenoh.join("ros", id=1, settings=patient(router)) as robot:
        robot.serve("add_node", refuse)
        async with await Headset.connect("127.0.0.1", gateway.port) as headset:
            await headset.subscribe("/secret", "my_msgs/Secret", agents=[1])
            message = await headset.receive(PATIENCE_S)
            assert message.metadata.message_manager == NodeRefused.manager
            refused = decode_data(NodeRefused, message.data)
            assert (refused.robot_id, refused.tos_name, refused.reason) == (1, "/secret", "no such type here")
            assert "robot 1 refused /secret: no such type here" in caplog.text


async def test_a_node_name_of_another_topic_is_refused(router: str, start_gateway: StartGateway) -> None:
    """What others send to a topic is not to be had by registering its node name for another; no robot is asked."""
    gateway = await start_gateway()
    asked = []

    async def accept(call: macs_zenoh.Call) -> bytes:
        asked.append(call)
        return b""

    async with macs_zenoh.join("ros", id=1, settings=patient(router)) as robot:
        robot.serve("add_node", accept)
        async with await Headset.connect("127.0.0.1", gateway.port) as headset:
            evil = NodeSpec(NodeType.PUBLISHER, "/evil_cmd", "geometry_msgs/Twist")
            object.__setattr__(evil, "name", "nd__cmd_vel")
            await headset.send_frame(registration(headset.id, evil, [1], []))
            refused = decode_data(NodeRefused, (await headset.receive(PATIENCE_S)).data)
            assert (refused.tos_name, refused.reason) == ("/evil_cmd", "'nd__cmd_vel' is not its node name")
            assert not asked


async def test_a_name_with_another_type_is_kept_away(
    router: str, start_gateway: StartGateway, connect: Connect
) -> None:
    """A message under the name of a headset's node with another node type, which would deafen it, is not sent."""
    gateway = await start_gateway()
    async with macs_zenoh.join("ros", id=1, settings=patient(router)) as robot:

        async def accept(call: macs_zenoh.Call) -> bytes:
            return b""

        robot.serve("add_node", accept)
        headset = await connect(gateway)
        await headset.subscribe("/pose", "geometry_msgs/Pose", agents=[1])
        await answers(headset)
        for node_type, name in ((NodeType.SERVICE, "nd__pose"), (0, "")):
            metadata = Metadata(node_type=int(node_type), node_name=name, message_manager="" if name else "Greeting")
            robot.send(b"to you", to="unity", ids=[headset.id], metadata=metadata)
        message = await headset.receive(PATIENCE_S)
        assert message.metadata.message_manager == "Greeting"
        assert gateway.agents.find(2, headset.id).drops["wrong_node_type"] == 1  # type: ignore[union-attr]


async def test_workers_share_a_port() -> None:
    """Gateways behind one port give out different ids, and their headsets reach each other."""
    async with AsyncExitStack() as stack:
        _, gateway = await stack.enter_async_context(site("--workers", "2"))
        headsets: dict[int, Headset] = {}
        while len({headset_id // 256 for headset_id in headsets}) < 2:
            headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
            headsets[headset.id] = headset
        first, last = headsets[min(headsets)], headsets[max(headsets)]
        while last.id not in (await first.online()).unity_agent_ids:
            await asyncio.sleep(0.02)
        await first.send(b"over there", to=2, ids=[last.id], manager="Greeting")
        assert bytes((await last.receive(PATIENCE_S)).data) == b"over there"


async def test_a_thousand_headsets() -> None:
    """A thousand headsets join one gateway, each with an id of its own, and an idle one costs at most 100 KiB."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 8192), hard))
    try:
        async with AsyncExitStack() as stack:
            _, gateway = await stack.enter_async_context(site())
            before = memory_bytes(gateway.pid)
            ids = set()
            for _ in range(20):
                joining = [Headset.connect("127.0.0.1", gateway.port) for _ in range(50)]
                for headset in await asyncio.gather(*joining):
                    await stack.enter_async_context(headset)
                    ids.add(headset.id)
            assert len(ids) == 1000
            assert set((await headset.online()).unity_agent_ids) == ids
            assert (memory_bytes(gateway.pid) - before) / 1000 < 100 * 1024
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


async def test_those_that_do_not_read_have_a_limit_together() -> None:
    """Ten headsets that do not read, and are sent two frames of 31 MiB each, cost a gateway what all may have
    together, not what each may; a neighbour is served, and all is as before when they have left."""
    async with AsyncExitStack() as stack:
        endpoint, gateway = await stack.enter_async_context(site())
        neighbour = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        stalled = [stack.enter_context(socket.create_connection(("127.0.0.1", gateway.port))) for _ in range(10)]
        for number, sock in enumerate(stalled):
            management = encode_management(Configuration(agent_type=2, agent_id=number + 2, group_id=0))
            sock.sendall(encode_frame(management=management))
        while len((await neighbour.online()).unity_agent_ids) < 11:
            await asyncio.sleep(0.05)
        sender = await stack.enter_async_context(macs_zenoh.join("ros", id=1, settings=patient(endpoint)))
        before = memory_bytes(gateway.pid)
        for _ in range(2):
            for number in range(10):
                sender.send(bytes(31 << 20), to="unity", ids=[number + 2], metadata=Metadata(message_manager="Big"))
                await asyncio.sleep(0.1)
        await until(lambda: any("outbox_full" in line for line in gateway.log))
        await answers(neighbour)
        await until(lambda: memory_bytes(gateway.pid) - before < (256 + 96) << 20)  # what was cut is given back soon
        for sock in stalled:
            sock.close()
        while len((await neighbour.online()).unity_agent_ids) > 1:
            await asyncio.sleep(0.05)


async def test_frames_that_do_not_end_have_a_limit_together() -> None:
    """Of fourteen frames that have come to 31 MiB and do not end, those that began first are cut when all together
    take too much; a neighbour, and whoever ends what it begins, are served."""
    async with AsyncExitStack() as stack:
        _, gateway = await stack.enter_async_context(site())
        neighbour = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        good = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        before = memory_bytes(gateway.pid)
        begun = struct.pack("<B30xII", 2, 0, 31 << 20) + bytes(30 << 20)
        halves = []
        for _ in range(14):
            reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port)
            stack.callback(writer.close)
            configuration = encode_management(Configuration(agent_type=2, agent_id=1, group_id=0))
            writer.write(encode_frame(management=configuration) + begun)
            with suppress(ConnectionError):
                await writer.drain()
            halves.append(reader)
        await good.send(bytes(4 << 20), to=2, ids=[neighbour.id])
        while len((await asyncio.wait_for(neighbour.__anext__(), PATIENCE_S)).data) < 4 << 20:
            pass
        await answers(neighbour)
        await until(lambda: memory_bytes(gateway.pid) - before < (256 + 96) << 20)  # what was cut is given back soon
        ended = asyncio.wait_for(halves[0].read(), PATIENCE_S)
        with suppress(ConnectionError):
            await ended
        await until(lambda: any("its frame does not end" in line for line in gateway.log))


async def test_a_group_is_chosen_from_its_networks(router: str, start_gateway: StartGateway) -> None:
    """Who comes from elsewhere is online in no group; groups that are not named are free."""
    gateway = await start_gateway(groups={"9": ["10.0.0.0/8"], "8": ["127.0.0.0/8", "::1"]})
    for chosen, got in ((9, 0), (8, 8), (7, 7)):
        async with await Headset.connect("127.0.0.1", gateway.port, group=chosen) as headset:
            await until(lambda headset=headset: gateway.directory.get(2, headset.id) is not None)
            found = gateway.directory.get(2, headset.id)
            assert found is not None
            assert found.group == got
