"""A gateway never stops admitting, and says so where it cannot."""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

import macs_zenoh
from bridge.gateway import Gateway, leases
from bridge.gateway.admission import Churn
from bridge.gateway.leases import Leases
from bridge.headset import frames
from macs_zenoh.mesh import Mesh, gathered
from macs_zenoh.presence import Presence
from macs_zenoh.protocol import ping
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.keyexpr import LEASE, PING
from macs_zenoh.protocol.messages import ROS, UNITY, Configuration, Welcome, decode_data, encode_management
from macs_zenoh.protocol.wire import encode_frame, split_message
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.programs import Program, free_port
from tests.support.waiting import PATIENCE_S, until


class Plain:
    """A TCP agent that takes its id and says who it is, no more."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self.writer = reader, writer
        self.id = 0

    async def read(self) -> bytes:
        """What comes next."""
        return await self._reader.read(65536)

    async def join(self, agent_type: int) -> None:
        """Wait for the greeting and answer it."""
        decoder = MessageDecoder(1 << 20)
        messages: list[bytes | bytearray | memoryview] = []
        while not messages:
            data = await self._reader.read(65536)
            if not data:
                raise ConnectionError
            messages += decoder.feed(data)
        self.id = decode_data(Welcome, bytes(split_message(messages[0])[1])).agent_id
        configuration = Configuration(agent_type=agent_type, agent_id=self.id, group_id=0, request_id=1)
        self.writer.write(encode_frame(management=encode_management(configuration)))


@asynccontextmanager
async def crowd(port: int, count: int, agent_type: int = UNITY, host: str = "127.0.0.1") -> AsyncIterator[list[Plain]]:
    """So many agents that connect from an address at once, and have all joined."""
    agents: list[Plain] = []

    async def come() -> None:
        agent = Plain(*await asyncio.open_connection("127.0.0.1", port, local_addr=(host, 0)))
        agents.append(agent)
        await agent.join(agent_type)

    try:
        await asyncio.wait_for(asyncio.gather(*(come() for _ in range(count))), 60)
        yield agents
    finally:
        for agent in agents:
            agent.writer.close()


async def test_a_burst_is_admitted() -> None:
    """With ten robots online 600 headsets that connect at once each get an id of their own, several times."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with (
        Program("router", "-l", endpoint),
        Program("gateway", "--port", "0", "-e", endpoint, "--robots", "any") as gateway,
        crowd(gateway.port, 10, ROS) as robots,
    ):
        for _ in range(3):
            async with crowd(gateway.port, 600) as headsets:
                ids = [agent.id for agent in [*robots, *headsets]]
                assert len(set(ids)) == 610


async def test_who_speaks_is_seen(
    start_gateway: StartGateway, connect: Connect, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of those who come together the presence waits for others, but not behind anything that one of them says."""
    monkeypatch.setattr(gathered, "GATHER_S", 60.0)
    gateway = await start_gateway()
    await connect(gateway)
    async with macs_zenoh.join("ros", id=1, settings=gateway.mesh.settings) as robot:
        seen: list[str] = []
        robot.on_presence(lambda agent, online: seen.append(f"{agent.key} {online}") if agent.id > 1 else None)
        second = await connect(gateway)
        await until(lambda: len(list(gateway.agents.online())) == 2)
        assert gateway.directory.ids(UNITY) == [1]
        assert (await second.online()).unity_agent_ids == [1, 2]
        await until(lambda: gateway.directory.ids(UNITY) == [1, 2])
        await until(lambda: seen == ["unity/2 True"])


async def test_sockets_are_tuned(start_gateway: StartGateway, connect: Connect) -> None:
    """Small messages do not wait, and dead hosts are noticed: each connection has that of its listening socket."""
    gateway = await start_gateway()
    await connect(gateway)
    (connection,) = gateway.agents.connections()
    accepted = connection._transport.get_extra_info("socket")
    wanted = {socket.TCP_NODELAY: 1, socket.TCP_KEEPIDLE: 10, socket.TCP_KEEPINTVL: 3, socket.TCP_KEEPCNT: 3}
    assert {name: accepted.getsockopt(socket.IPPROTO_TCP, name) for name in wanted} == wanted
    assert accepted.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1


async def test_an_empty_answer_is_not_believed(start_gateway: StartGateway, monkeypatch: pytest.MonkeyPatch) -> None:
    """When routers answer that no block is leased, as they do under load, what the gateway holds stays its own, and
    the next block is another one."""
    gateway = await start_gateway()
    tokens = Mesh.tokens
    empty = 0

    async def sometimes(mesh: Mesh, key: str, *, timeout_s: float = 2.0) -> list[str]:
        nonlocal empty
        empty += 1
        return [] if key == LEASE.every() and empty % 3 else await tokens(mesh, key, timeout_s=timeout_s)

    monkeypatch.setattr(Mesh, "tokens", sometimes)
    async with crowd(gateway.port, 700) as agents:
        assert len({agent.id for agent in agents}) == 700
        assert sorted(gateway.blocks) == list(range(len(gateway.blocks)))


async def test_who_waits_for_an_id_may_speak_and_leave(
    start_gateway: StartGateway, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Connections that wait for an id may send what they like and leave: nothing fails; the next is served. Who waits
    for long is named in the log and to the doctor."""
    gateway = await start_gateway()
    takes = asyncio.Event()
    take_id = Leases.take_id
    monkeypatch.setattr(Leases, "take_id", lambda *args, **named: take_id(*args, **named) if takes.is_set() else None)
    early = encode_frame(management=encode_management(Configuration(agent_type=2, agent_id=0, group_id=0)))
    stays = Plain(*await asyncio.open_connection("127.0.0.1", gateway.port))
    stays.writer.write(early)
    for linger in (struct.pack("ii", 0, 0), struct.pack("ii", 1, 0)):  # it ends politely, or not
        _, writer = await asyncio.open_connection("127.0.0.1", gateway.port)
        writer.write(early)
        await asyncio.sleep(0.05)
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        writer.close()
    await until(lambda: "3 connections wait for an id" in caplog.text)
    answer, _ = ping.decode(await gateway.mesh.query(PING.of(zid=gateway.mesh.zid), b"", timeout_s=PATIENCE_S))
    assert answer.now == {"waiting_for_id": 3}
    takes.set()
    async with crowd(gateway.port, 1):
        await asyncio.wait_for(stays.join(UNITY), PATIENCE_S)
        await until(lambda: len(gateway.agents) == 2)
    stays.writer.close()
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


async def test_when_there_are_no_ids_a_newcomer_is_closed(start_gateway: StartGateway) -> None:
    """A gateway whose blocks are used up closes who comes, and counts it; when somebody leaves, the next is let in."""
    gateway: Gateway = await start_gateway(blocks=[5], handshake_timeout_s=10.0)
    async with crowd(gateway.port, 128) as agents, crowd(gateway.port, 128, host="127.0.0.2") as others:
        assert {agent.id for agent in (*agents, *others)} == set(range(5 * 256, 6 * 256))
        reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port)
        assert await asyncio.wait_for(reader.read(), PATIENCE_S) == b""
        writer.close()
        assert gateway.drops["no_id"] == 1
        agents[7].writer.close()
        await until(lambda: len(gateway.agents) == 255)
        async with crowd(gateway.port, 1) as late:
            assert late[0].id == agents[7].id


async def test_whoever_held_all_blocks_keeps_nobody_out_when_he_has_gone(
    start_gateway: StartGateway, router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who comes while there are no ids is closed; who comes when there are some again waits for them, and is served,
    though the last attempt to have more was in vain."""
    monkeypatch.setattr(leases, "AGAIN_S", 0.1)
    gateway: Gateway = await start_gateway(block=0)
    async with await Mesh.open(patient(router)) as mesh:
        held = [mesh.declare_token(LEASE.of(block=block, zid="0")) for block in range(1, 256)]
        await until(lambda: len(gateway._leases._holders) == 256)
        async with crowd(gateway.port, 255):
            reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port)
            assert await asyncio.wait_for(reader.read(), PATIENCE_S) == b""
            writer.close()
            for token in held:
                token.close()
            await until(lambda: sum(map(bool, gateway._leases._holders.values())) == 1)
            await until(lambda: gateway._leases._taking is None)
            async with crowd(gateway.port, 1) as late:
                assert late[0].id >= 256


async def test_changing_groups_is_no_departure(start_gateway: StartGateway) -> None:
    """An agent that changes its group many times at once is online all the time, ends in the last one, and costs
    others two changes, not hundreds."""
    near, far = await start_gateway(), await start_gateway()
    changes: list[tuple[int, bool]] = []
    async with crowd(near.port, 1) as agents, await Mesh.open(far.mesh.settings) as watcher:
        me = (UNITY, agents[0].id)
        await until(lambda: me in far.directory)
        presence = Presence(watcher, lambda news: changes.extend((c.agent.group, c.online) for c in news), nothing)
        await presence.start()
        for burst in (5, 300):
            for group in [*range(1, burst), 77]:
                configuration = Configuration(agent_type=UNITY, agent_id=me[1], group_id=group % 200, request_id=1)
                agents[0].writer.write(encode_frame(management=encode_management(configuration)))
            await until(lambda: changes and changes[-1] == (77, True))
            await until(lambda: (agent := far.directory.get(*me)) is not None and agent.group == 77)
            await asyncio.sleep(0.5)
        assert all(online for _, online in changes)
        assert len(changes) < 12
        presence.close()


def nothing(_: object) -> None:
    """What nobody wants to know."""


async def test_who_asks_too_much_is_slowed(start_gateway: StartGateway) -> None:
    """Somebody who asks all the time who is online is read from more slowly, and counted; a neighbour is answered."""
    gateway = await start_gateway()
    async with crowd(gateway.port, 2) as (greedy, neighbour):
        greedy.writer.write(frames.online_request(greedy.id, 1) * 3000)
        before = len(gateway.agents)
        await until(lambda: gateway.agents.find(UNITY, greedy.id).drops["slowed_down"])  # type: ignore[union-attr]
        neighbour.writer.write(frames.online_request(neighbour.id, 1))
        assert await asyncio.wait_for(neighbour.read(), PATIENCE_S)
        assert before == 2


async def test_without_descriptors_it_is_said() -> None:
    """A gateway that has no descriptors left turns newcomers away, says so and how many, keeps serving those that are
    there, and lets others in when there is room again. At its start it says that they will not be enough."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    few = ("sh", "-c", 'ulimit -n 128; exec "$@"', "sh")
    async with (
        Program("router", "-l", endpoint),
        Program("gateway", "--port", "0", "-e", endpoint, within=few) as gateway,
        crowd(gateway.port, 20) as there,
    ):
        await until(lambda: "connections have room" in "\n".join(gateway.log))
        newcomers = [await asyncio.open_connection("127.0.0.1", gateway.port) for _ in range(150)]
        ends = [await asyncio.wait_for(reader.read(1), PATIENCE_S) for reader, _ in newcomers]
        assert 20 < ends.count(b"") < 150
        for _, writer in newcomers:
            writer.close()
        there[0].writer.write(frames.online_request(there[0].id, 1))
        assert await asyncio.wait_for(there[0].read(), PATIENCE_S)
        deadline = time.monotonic() + PATIENCE_S
        while True:
            try:
                async with crowd(gateway.port, 20):
                    break
            except ConnectionError:  # it has not yet seen that the others are gone
                assert time.monotonic() < deadline
    await until(lambda: "there are no descriptors left" in "\n".join(gateway.log))


async def test_many_that_come_and_go_wait_and_others_do_not(
    start_gateway: StartGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After so many short connections from one address the next from there is greeted, later; and it is said. From
    elsewhere nobody waits for that: a headset is greeted while the other one is not."""
    monkeypatch.setattr(Churn, "FREE", 20)
    monkeypatch.setattr(Churn, "PER_S", 2.0)
    gateway = await start_gateway()

    async def greeted(address: str) -> asyncio.StreamWriter:
        reader, writer = await asyncio.open_connection("127.0.0.1", gateway.port, local_addr=(address, 0))
        assert await asyncio.wait_for(reader.read(8), PATIENCE_S)
        return writer

    for _ in range(25):
        (await greeted("127.0.0.2")).close()
    await until(lambda: not gateway.agents)
    waiting = asyncio.create_task(greeted("127.0.0.2"))
    await until(lambda: gateway.drops["coming_and_going"])
    other = await greeted("127.0.0.1")
    assert not waiting.done()
    (await waiting).close()
    other.close()
