"""Headsets that come back over another socket as the same agent: real sockets, lost in every way."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import signal
import tracemalloc
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import get_args

import pytest

import macs_zenoh
from bridge.gateway import Gateway, departures
from bridge.gateway.sleepers import CALM_S
from bridge.headset import frames
from bridge.headset.client import Headset, Link
from bridge.headset.nodes import Incoming
from bridge.headset.stream import Way, open_stream
from bridge.tokens import store
from macs_zenoh.agent import Agent
from macs_zenoh.errors import Unreachable
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.messages import (
    UNITY,
    AddNode,
    AgentsGone,
    Metadata,
    NodeType,
    SessionOpened,
    SessionResumed,
    StreamData,
    Welcome,
    decode_data,
    encode_management,
)
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from macs_zenoh.protocol.wire import encode_frame, encode_message, split_message
from macs_zenoh.streams import Streams
from tests.support.certificates import Authority
from tests.support.gateways import way_in
from tests.support.given import StartGateway
from tests.support.local import patient
from tests.support.networks import Loss, Network, network
from tests.support.programs import Program, free_port
from tests.support.waiting import until

TOPICS = 50
STRING = "std_msgs/String"
CDR = b"\0\1\0\0"

LOSSES: list[Loss] = list(get_args(Loss))


class Robot:
    """A robot on the mesh: takes every registration, numbers the messages of its topics, and answers calls when it is
    let."""

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self.asked: list[AddNode] = []
        self.heard: list[tuple[AgentInfo, bool]] = []
        self.slept: list[bool] = []
        self.waiting: list[Message] = []
        self._streams = Streams(agent)
        agent.serve("add_node", self._add)
        agent.on_message(self._take)
        agent.on_presence(lambda agent, online: self.heard.append((agent, online)))
        agent.on_asleep(lambda agent: self.slept.append(bool(agent.asleep)))

    async def _add(self, call: macs_zenoh.Call) -> bytes:
        self.asked.append(decode_data(AddNode, call.data))
        return b""

    def _take(self, message: Message) -> None:
        if message.metadata.node_type == NodeType.CLIENT:
            self.waiting.append(message)

    def answer(self) -> None:
        """All calls that wait."""
        waiting, self.waiting = self.waiting, []
        for message in waiting:
            asked = message.metadata
            metadata = Metadata(1, 1, asked.request_id, "", NodeType.CLIENT, asked.node_name, asked.data_exchange_type)
            self.agent.reply(message, CDR + b"answer " + bytes(message.data[4:]), metadata=metadata)

    async def publish(self) -> None:
        """On every topic, again and again."""
        number = 0
        while True:
            nodes = {each.node_name: each.registrant_agent_id for each in self.asked if each.node_type == 1}
            for name, registrant in nodes.items():
                metadata = Metadata(1, 1, 0, StreamData.manager, NodeType.SUBSCRIBER, name, STRING)
                management = encode_management(StreamData({"2": [registrant]}))
                text = encode_message(metadata.encode(), CDR + b"%d" % number)
                self._streams.publish(name, encode_frame(1, management=management, message=text))
            number += 1
            await asyncio.sleep(0.02)


@pytest.fixture
async def robot(router: str) -> AsyncIterator[Robot]:
    """Robot 1 in group 3."""
    async with macs_zenoh.join("ros", id=1, group=3, settings=patient(router)) as agent:
        made = Robot(agent)
        publishing = asyncio.create_task(made.publish())
        yield made
        publishing.cancel()


Come = Callable[..., Awaitable[Headset]]


class Site:
    """A gateway with all its ports, and a network before one of them."""

    def __init__(self, gateway: Gateway, authority: str) -> None:
        self.gateway = gateway
        self.authority = authority

    def way(self, port: str) -> tuple[int, Way]:
        """How it is reached there."""
        return way_in(self.gateway, port, self.authority)

    @asynccontextmanager
    async def headset(self, port: str, **options: object) -> AsyncIterator[tuple[Headset, Network]]:
        """One that comes back, behind a network of its own."""
        number, way = self.way(port)
        async with network(number) as net:
            connecting = Headset.connect("127.0.0.1", net.port, reconnect=True, way=way, **options)  # type: ignore[arg-type]
            async with await connecting as headset:
                await told(headset)
                yield headset, net


StartSite = Callable[..., Awaitable[Site]]


@pytest.fixture
async def start_site(start_gateway: StartGateway, tmp_path: Path) -> StartSite:
    """Starts one; keyword arguments are settings of its gateway."""
    authority = Authority(tmp_path / "ca")
    certificate, key = authority.issue("gateway")

    async def start(**settings: object) -> Site:
        said = {"tokens_file": str(tmp_path / "tokens.json"), "certificate": str(certificate), "key": str(key)}
        gateway = await start_gateway(tls_port=0, web_port=0, **{**said, **settings})
        return Site(gateway, str(authority.ca))

    return start


async def told(headset: Headset) -> None:
    """Wait until it knows by which secret it can come back: whoever loses its connection before is another one."""
    await until(lambda: headset._session is not None and headset._session.secret)


async def back(headset: Headset, net: Network, how: Loss) -> None:
    """Lose its network, and wait until it is there again."""
    before = net.connections
    net.lose(how)
    if how == "silence":
        headset.drop_connection()
    await until(lambda: net.connections > before and headset.connected)


@pytest.mark.parametrize("port", ["plain", "tls", "web"])
@pytest.mark.parametrize("how", [*LOSSES, "address"])
async def test_a_headset_that_comes_back_is_the_same(start_site: StartSite, robot: Robot, port: str, how: str) -> None:
    """With fifty topics, a call under way and messages in both directions: it keeps its id, group and registrations,
    the answer arrives, no message is lost, or comes twice, but for topics'; and nobody hears of it."""
    site = await start_site()
    links: list[Link] = []
    numbers: dict[str, list[int]] = {f"/topic_{each}": [] for each in range(TOPICS)}
    async with (
        site.headset(port, group=3, on_link=links.append) as (headset, net),
        await Headset.connect("127.0.0.1", site.gateway.port) as other,
    ):
        own_id = headset.id
        await until(lambda: (UNITY, own_id) in robot.agent.directory and (UNITY, other.id) in robot.agent.directory)

        def note(topic: str, message: Incoming) -> None:
            numbers[topic].append(int(message.data[4:]))

        for topic in numbers:
            await headset.subscribe(
                topic, STRING, agents=[1], callback=lambda message, topic=topic: note(topic, message)
            )
        await until(lambda: all(numbers.values()))
        robot.heard.clear()
        stop = asyncio.Event()

        async def talk(sender: Headset, to: int) -> int:
            number = 0
            while not stop.is_set():
                with contextlib.suppress(Unreachable):
                    await sender.send(b"%d" % number, to=UNITY, ids=[to])
                    number += 1
                await asyncio.sleep(0.002)
            return number

        talking = [asyncio.create_task(talk(headset, other.id)), asyncio.create_task(talk(other, own_id))]
        for _ in range(3):
            call = asyncio.create_task(headset.call("/set", "pkg/T", 1, CDR + b"request", timeout_s=60))
            await until(lambda: robot.waiting)
            if how == "address":
                net.address = "127.0.0.2" if net.address == "127.0.0.1" else "127.0.0.1"
            before = net.connections
            silent = how in ("silence", "address")
            net.lose("silence" if silent else how)  # type: ignore[arg-type]
            robot.answer()
            if silent:
                await asyncio.sleep(0.05)  # so that the answer goes into the old socket, which nobody reads
                headset.drop_connection()
            await until(lambda before=before: net.connections > before and headset.connected)
            assert await call == CDR + b"answer request"
            seen = {topic: len(each) for topic, each in numbers.items()}
            await until(lambda seen=seen: all(len(each) > seen[topic] for topic, each in numbers.items()))
        stop.set()
        for talked, receiver in zip(talking, (other, headset), strict=True):
            count = await talked
            assert [int((await receiver.receive(30)).data) for _ in range(count)] == list(range(count))
            with pytest.raises(macs_zenoh.CallTimeout):
                await receiver.receive(0.05)
        assert headset.id == own_id
        for each in numbers.values():
            assert each == sorted(set(each))
        # each once, but that a gateway on a busy machine may ask again for what has no answer yet
        assert len({(each.registrant_agent_id, each.tos_name) for each in robot.asked}) == TOPICS + 1
        assert [node.registrant_agent_id for node in robot.asked] == [own_id] * (TOPICS + 1)
        assert robot.heard == []
        await until(lambda: not robot.slept[-1])
        assert robot.slept.count(True) == 3
        assert [link.resumed for link in links if link.up] == [False, True, True, True]
        (connection,) = [each for each in site.gateway.agents.online() if each.agent_id == own_id]
        assert connection.host == net.address
        assert connection.peer.group == 3
        assert len(site.gateway.agents) == 2


async def test_it_may_come_back_by_another_port(start_site: StartSite) -> None:
    """From the plain port to TLS, to the web port, and back."""
    site = await start_site()
    streams = [(site.way(port)) for port in ("plain", "tls", "web", "plain")]
    secret, ids = "", set()
    for number, way in streams:
        stream = await open_stream("127.0.0.1", number, way)
        decoder, messages = MessageDecoder(), []

        async def receive(stream=stream, decoder=decoder, messages=messages) -> tuple[Metadata, bytes]:  # type: ignore[no-untyped-def]
            while not messages:
                messages += decoder.feed(await stream.read())
            metadata, data = split_message(messages.pop(0))
            return Metadata.decode(metadata), bytes(data)

        _, data = await receive()
        welcome = decode_data(Welcome, data)
        stream.write(frames.configuration(welcome.agent_id, 0, 1, 1, None, secret))
        metadata, data = await receive()
        if secret:
            assert metadata.message_manager == SessionResumed.manager
            ids.add(decode_data(SessionResumed, data).agent_id)
        else:
            opened = decode_data(SessionOpened, data)
            assert opened.resume_s == 30
            secret = opened.session
            ids.add(welcome.agent_id)
    assert len(ids) == 1
    await until(lambda: len(site.gateway.agents) == 1)


async def test_who_does_not_come_back_leaves(start_site: StartSite, robot: Robot) -> None:
    """When its time is over, everybody hears of it once; who says goodbye, and who never asked for it, leaves at
    once."""
    site = await start_site(resume_s=0.5)
    async with await Headset.connect("127.0.0.1", site.gateway.port) as other:
        for reconnect, goodbye in ((True, False), (True, True), (False, False)):
            headset = await Headset.connect("127.0.0.1", site.gateway.port, reconnect=reconnect)
            gone = headset.id
            await until(lambda gone=gone: (UNITY, gone) in robot.agent.directory)
            robot.slept.clear()
            await (headset.close() if goodbye else headset.abort())
            message = await other.receive(30)
            assert message.metadata.message_manager == AgentsGone.manager
            assert [agent.agent_id for agent in decode_data(AgentsGone, message.data).agents] == [gone]
            await until(lambda gone=gone: (UNITY, gone) not in robot.agent.directory)
            assert robot.slept == ([True] if reconnect and not goodbye else [])
        assert len(site.gateway.agents) == 1
        assert site.gateway._sleepers.kept_bytes == 0


async def test_who_was_moving_something_is_seen_asleep_even_if_it_is_back(
    start_site: StartSite, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where many fall asleep it may be the turn of one when it is back already: robots stop what it was moving all the
    same. Of one that only listens nobody needs to see that."""
    monkeypatch.setattr(departures, "AT_ONCE", 0)
    monkeypatch.setattr(departures, "MORE", 1)
    monkeypatch.setattr(departures, "EVERY_S", 3600.0)
    site = await start_site()
    turnstile = site.gateway._sleepers._seen_late
    async with site.headset("plain") as (listens, its_net), site.headset("plain") as (drives, net):
        await drives.advertise("/cmd_vel", STRING, agents=[1])
        await until(lambda: robot.asked)
        await back(listens, its_net, "reset")
        await back(drives, net, "reset")
        assert robot.slept == []

        def is_seen() -> bool:
            turnstile._again()
            return robot.slept == [True, False]

        await until(is_seen)
        await asyncio.sleep(2 * CALM_S)
        assert is_seen()


async def test_the_secret_alone_opens_nothing(start_site: StartSite, tmp_path: Path) -> None:
    """Not without the token, nor with another's, nor after the token was taken back; its owner notices nothing, and
    who tried is counted."""
    nobody = {"plain_without_token": "nobody", "tls_without_token": "everybody", "web_without_token": "nobody"}
    site = await start_site(**nobody)
    path = tmp_path / "tokens.json"

    def make(name: str) -> str:
        secret = new_secret(os.urandom(32))
        token = Token(name=name, rights=Rights(may=["see"]), hashes=[hash_of(secret)])
        store.change(path, lambda tokens: (tokens.with_token(token), None))
        return secret

    anna, bert = make("anna"), make("bert")
    async with site.headset("plain", token=anna) as (headset, net):
        await headset.online()
        own_id, session = headset.id, headset._session
        assert session is not None

        async def tries(port: str, token: str | None, secret: str) -> str:
            number, way = site.way(port)
            stream = await open_stream("127.0.0.1", number, way)
            stream.write(frames.configuration(0, 0, 1, 1, token, secret))
            decoder, seen = MessageDecoder(), []
            while len(seen) < 2:
                seen += decoder.feed(await stream.read())
            stream.abort()
            return Metadata.decode(split_message(seen[1])[0]).message_manager

        for shown in (session.secret, session.secret[:-1], new_secret(os.urandom(32))):
            assert await tries("plain", bert, shown) == SessionOpened.manager
            assert await tries("tls", None, shown) == SessionOpened.manager
            assert await tries("plain", None, shown) == "AccessRefused"
        assert await tries("tls", anna, session.secret[:-1]) == SessionOpened.manager
        await headset.online()
        assert headset.id == own_id
        await until(lambda: site.gateway.drops["not_resumed"] == 7)
        await back(headset, net, "rst")
        assert headset.id == own_id
        net.lose("rst")
        store.change(path, lambda tokens: (tokens.without("anna"), None))
        assert await headset.wait_ended() in ("a valid token is wanted here", "this token holds no longer")
    # who tried sleeps for half a minute more
    await until(lambda: own_id not in {each.agent_id for each in site.gateway.agents.online()})


async def test_a_gateway_that_died_has_new_agents(router: str, robot: Robot) -> None:
    """Its headset is told that it is another one, fails what waited, and registers all that it had."""
    port = free_port()
    async with (
        Program("gateway", "-e", router, "--port", str(port)) as gateway,
        await Headset.connect("127.0.0.1", port, reconnect=True) as headset,
    ):
        node = await headset.subscribe("/topic", STRING, agents=[1])
        first = int((await node.__anext__()).data[4:])
        call = asyncio.create_task(headset.call("/set", "pkg/T", 1, CDR, timeout_s=60))
        await until(lambda: robot.waiting)
        robot.asked.clear()
        await gateway.stop(signal.SIGKILL)
        await gateway.start()
        with pytest.raises(Unreachable):
            await call
        await until(lambda: headset.connected and robot.asked)
        assert {asked.registrant_agent_id for asked in robot.asked} == {headset.id}
        while int((await node.__anext__()).data[4:]) < first + 50:
            pass


async def test_it_holds_on_the_loop_that_programs_use(router: str, tmp_path: Path) -> None:
    """On each port, with every loss: messages in both directions arrive once and in order."""
    authority = Authority(tmp_path / "ca")
    certificate, key = map(str, authority.issue("gateway"))
    tls, web = free_port(), free_port()
    ports = ["--port", "0", "--tls-port", str(tls), "--web-port", str(web), "--certificate", certificate, "--key", key]
    async with Program("gateway", "-e", router, *ports) as gateway:
        for port, way in [
            (gateway.port, Way()),
            (tls, Way(tls=True, authority=str(authority.ca))),
            (web, Way(websocket=True)),
        ]:
            async with (
                network(port) as net,
                await Headset.connect("127.0.0.1", net.port, reconnect=True, way=way) as headset,
                await Headset.connect("127.0.0.1", gateway.port) as other,
            ):
                own_id = headset.id
                await told(headset)
                await other.online()
                for number, how in enumerate(LOSSES * 5):
                    await headset.send(b"%d" % number, to=UNITY, ids=[other.id])
                    await other.send(b"%d" % number, to=UNITY, ids=[own_id])
                    await back(headset, net, how)
                    assert headset.id == own_id
                for receiver in (headset, other):
                    seen: list[int] = []
                    while len(seen) < 5 * len(LOSSES):
                        message = await receiver.receive(30)
                        if not message.metadata.message_manager:  # else it tells that those of before have left
                            seen.append(int(message.data))
                    assert seen == list(range(5 * len(LOSSES)))


async def test_so_many_sleep_and_no_more(start_site: StartSite, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one address; whoever is more leaves at once, and what waits for those who sleep is bounded."""
    monkeypatch.setattr("bridge.gateway.sleepers.ASLEEP_PER_ADDRESS", 5)
    monkeypatch.setattr("bridge.gateway.connection.ASLEEP_BYTES", 100_000)
    site = await start_site()
    headsets = [await Headset.connect("127.0.0.1", site.gateway.port, reconnect=True) for _ in range(9)]
    async with await Headset.connect("127.0.0.1", site.gateway.port) as other:
        await until(lambda: len(list(site.gateway.agents.online())) == 10)
        for headset in headsets:
            await headset.abort()
        await until(lambda: len(site.gateway.agents) == 6)
        assert len(site.gateway._sleepers) == 5
        asleep = [each for each in site.gateway.agents.online() if each.asleep]
        for _ in range(50):
            await other.send(bytes(10_000), to=UNITY, ids=[each.agent_id for each in asleep])
        await other.online()
        await until(lambda: all(each.drops["outbox_full"] or each._outbox.drops["outbox_full"] for each in asleep))
        assert all(each._outbox.bytes <= 100_000 for each in asleep)
        assert site.gateway.drops["not_kept"] == 4


async def test_a_thousand_times_leave_nothing_behind(start_site: StartSite, caplog: pytest.LogCaptureFixture) -> None:
    """In a row, with what is said meanwhile: the same id each time, and no memory."""
    caplog.set_level(logging.ERROR)  # what is logged is kept until the end of the test
    site = await start_site()
    async with (
        site.headset("plain", group=3) as (headset, net),
        await Headset.connect("127.0.0.1", site.gateway.port) as other,
    ):
        own_id = headset.id
        site.gateway._entry.churn.PER_S = 1e9  # type: ignore[misc]
        said = 0

        async def times(count: int) -> None:
            nonlocal said
            for _ in range(count):
                before = net.connections
                net.lose("rst")
                await other.send(b"%d" % said, to=UNITY, ids=[own_id])
                assert int((await headset.receive(60)).data) == said
                said += 1
                await until(lambda before=before: net.connections > before and headset.connected, every_s=0.001)

        await times(100)
        gc.collect()
        tracemalloc.start()
        await times(100)
        gc.collect()
        before, _ = tracemalloc.get_traced_memory()
        await times(800)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        print(f"1 000 times: {after - before} bytes more")
        assert headset.id == own_id
        # Timers that were cancelled wait in the event loop until they are a hundred: some 30 KB, more or less. One
        # string for each return would be more than all that may remain.
        assert after - before < 64 << 10
        assert len(site.gateway.agents) == 2
        assert len(site.gateway._sleepers) == 0
        everybody = sorted({own_id, other.id})
        await until(lambda: [agent.id for agent in site.gateway.directory.of_type(UNITY)] == everybody)
