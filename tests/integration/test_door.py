"""The ports of a gateway, who is let in there, and what a token permits: real sockets, TLS and WebSockets."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gc
import json
import os
import re
import socket
import ssl
import struct
import sys
import threading
import time
import weakref
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack
from pathlib import Path
from typing import NamedTuple

import aiohttp
import pytest

from bridge import memory
from bridge.gateway import Gateway
from bridge.gateway.admission import Churn
from bridge.headset import frames
from bridge.headset.client import Headset
from bridge.headset.frames import NodeSpec
from bridge.headset.stream import Way, open_stream
from bridge.tokens import store
from macs_zenoh.agent import Agent
from macs_zenoh.errors import Refused, Unreachable
from macs_zenoh.joining import join
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    AccessRefused,
    AddNode,
    AgentsGone,
    Configuration,
    NodeRefused,
    NodeType,
    decode_data,
    encode_data,
    encode_management,
)
from macs_zenoh.protocol.rights import Right, Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_pairing, new_secret
from macs_zenoh.protocol.websocket import SUBPROTOCOL, TOKEN_SUBPROTOCOL
from macs_zenoh.protocol.wire import encode_frame, split_message
from macs_zenoh.serving import Call
from tests.support.certificates import Authority
from tests.support.gateways import way_in
from tests.support.given import StartGateway
from tests.support.local import patient
from tests.support.programs import Program, ended, free_port, macs
from tests.support.thorough import examples
from tests.support.waiting import PATIENCE_S, until

PORTS = ["plain", "tls", "web", "web_tls"]


class Tokens:
    """A file of tokens."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def make(self, name: str, **rights: object) -> str:
        """A token with these rights; its secret."""
        secret = new_secret(os.urandom(32))
        expires_at = rights.pop("expires_at", None)
        token = Token(name=name, rights=Rights(**rights), hashes=[hash_of(secret)], expires_at=expires_at)  # type: ignore[arg-type]
        store.change(self.path, lambda tokens: (tokens.with_token(token), None))
        return secret

    def revoke(self, name: str) -> None:
        """End one."""
        store.change(self.path, lambda tokens: (tokens.without(name), None))


@pytest.fixture
def tokens(tmp_path: Path) -> Tokens:
    """Of a site that has none yet."""
    return Tokens(tmp_path / "macs" / "tokens.json")


class Door(NamedTuple):
    """A gateway with all its ports, of which ``web`` is without TLS and ``web_tls`` another gateway's."""

    gateway: Gateway
    other: Gateway
    authority: str
    tokens: Tokens

    def way(self, port: str) -> tuple[int, Way]:
        """How it is reached there."""
        if port == "web_tls":
            return self.other.listeners.web_port, Way(websocket=True, tls=True, authority=self.authority)
        return way_in(self.gateway, port, self.authority)

    async def come(self, port: str, token: str | None = None, **options: object) -> Headset:
        """A headset by way of one of the ports."""
        number, way = self.way(port)
        return await Headset.connect("127.0.0.1", number, token=token, way=way, **options)  # type: ignore[arg-type]

    def know(self, *agents: tuple[int, int]) -> bool:
        """Whether both gateways see these agents (type, id) online."""
        return all(agent in gateway.directory for gateway in (self.gateway, self.other) for agent in agents)


StartDoor = Callable[..., Awaitable[Door]]


@pytest.fixture
async def start_door(start_gateway: StartGateway, tokens: Tokens, tmp_path: Path) -> StartDoor:
    """Starts it; keyword arguments are settings."""
    authority = Authority(tmp_path / "ca")
    certificate, key = authority.issue("gateway")

    async def start(**settings: object) -> Door:
        said = {"tokens_file": str(tokens.path), "certificate": str(certificate), "key": str(key), **settings}
        gateway = await start_gateway(tls_port=0, web_port=0, **said)
        # of one that others can reach, but nobody is told
        other = await start_gateway(web_port=0, **{**said, "web_host": "0.0.0.0"})
        return Door(gateway, other, str(authority.ca), tokens)

    return start


NOBODY = {"plain_without_token": "nobody", "tls_without_token": "nobody", "web_without_token": "nobody"}


@pytest.fixture
async def robots(router: str) -> AsyncIterator[list[Agent]]:
    """Robots 1 and 2, the first in group 3, the second in group 4."""
    async with AsyncExitStack() as stack:
        made = []
        for number in (1, 2):
            joining = join(ROS, id=number, group=3 if number == 1 else 4, settings=patient(router))
            agent = await stack.enter_async_context(joining)
            made.append(agent)
        yield made


@pytest.mark.parametrize("port", PORTS)
async def test_each_port_leads_to_the_same_agents(start_door: StartDoor, port: str) -> None:
    """A headset that came by TLS or WebSocket and one that came plainly send each other anything, small and large."""
    door = await start_door(web_without_token="everybody")
    async with await door.come(port, group=3) as one, await Headset.connect("127.0.0.1", door.gateway.port) as two:
        await until(lambda: door.know((UNITY, one.id), (UNITY, two.id)))
        for size in (0, 1, 125, 126, 65_535, 65_536, 3 << 20):
            data = os.urandom(size)
            await one.send(data, to=UNITY, ids=[two.id])
            assert (await two.receive(PATIENCE_S)).data == data
            await two.send(data, to=UNITY, ids=[one.id])
            assert (await one.receive(PATIENCE_S)).data == data
        numbers = range(examples(2000))
        for number in numbers:
            await one.send(b"%d" % number, to=UNITY, ids=[two.id])
        assert [int((await two.receive(PATIENCE_S)).data) for _ in numbers] == list(numbers)


@pytest.mark.parametrize("port", PORTS)
async def test_nobody_is_let_in_without_a_token(start_door: StartDoor, port: str) -> None:
    """Wrong, ended, revoked, cut off or foreign: each gets the same words, and an agent of none of them was seen."""
    door = await start_door(**NOBODY)
    good = door.tokens.make("good", may=["see"])
    ended = door.tokens.make("ended", expires_at=time.time() - 1)
    revoked = door.tokens.make("revoked")
    door.tokens.revoke("revoked")
    async with await door.come(port, good) as let_in:
        await let_in.online()
    told = set()
    for shown in (ended, revoked, good[:-1], good + "x", new_secret(os.urandom(32)), "x", "", "x" * 5000):
        with pytest.raises(Refused) as refused:
            await door.come(port, shown)
        told.add(str(refused.value))
    async with await door.come(port) as without:
        told.add(await without.wait_ended())
    assert told == {"a valid token is wanted here"}
    await until(lambda: not [*door.gateway.agents.connections(), *door.other.agents.connections()])
    assert (door.gateway.drops + door.other.drops)["NotAdmitted"] == 9


@pytest.mark.parametrize("port", PORTS)
async def test_a_token_is_held_to_its_rights(start_door: StartDoor, robots: list[Agent], port: str) -> None:
    """What a token permits arrives, what it does not makes no byte arrive, and its agent is told."""
    door = await start_door(**NOBODY)
    heard: dict[int, list[bytes]] = {1: [], 2: []}
    for robot in robots:
        robot.on_message(lambda message, number=robot.id: heard[number].append(bytes(message.data)))
    token = door.tokens.make("anna", may=["ask", "send"], robots=[1], groups=[3])
    async with await door.come(port, token) as anna, await door.come(port, token) as bert:
        await until(lambda: door.know((ROS, 1), (ROS, 2), (UNITY, anna.id), (UNITY, bert.id)))
        await anna.send(b"allowed", to=ROS, ids=[1])
        for forbidden in ({"ids": [2]}, {"ids": [1, 2]}, {"groups": [4]}, {"ids": [1], "groups": [4]}):
            await anna.send(b"forbidden", to=ROS, **forbidden)  # type: ignore[arg-type]
        await anna.send(b"forbidden")  # to everybody
        await anna.send(b"hello", to=UNITY, ids=[bert.id])
        assert (await bert.receive(PATIENCE_S)).data == b"hello"
        await anna.send(b"last", to=ROS, ids=[1])
        await until(lambda: b"last" in heard[1])
        assert heard == {1: [b"allowed", b"last"], 2: []}
        await anna.online()
        assert {refused.kind for refused in anna.forbidden} == {"not_permitted"}
        assert len(anna.forbidden) >= 4
    await until(lambda: (door.gateway.drops + door.other.drops)["NotPermitted"] == 5)


@pytest.mark.parametrize("port", PORTS)
async def test_each_right_holds_on_each_port(start_door: StartDoor, robots: list[Agent], port: str) -> None:
    """For each kind of interface node: with its right robot 1 is asked for it and gets its data, by id and by group;
    without it, at robot 2, in another group or for another topic nothing arrives, and the headset is told why."""
    door = await start_door(**NOBODY)
    asked: dict[int, list[tuple[int, str]]] = {1: [], 2: []}
    heard: dict[int, list[tuple[int, bytes]]] = {1: [], 2: []}

    async def answer(robot: int, call: Call) -> bytes:
        node = decode_data(AddNode, call.data)
        asked[robot].append((node.node_type, node.tos_name))
        return b""

    for robot in robots:
        robot.serve("add_node", functools.partial(answer, robot.id))
        robot.on_message(
            lambda message, number=robot.id: heard[number].append((message.metadata.node_type, bytes(message.data)))
        )
    rights: dict[NodeType, Right] = {
        NodeType.SUBSCRIBER: "see",
        NodeType.PUBLISHER: "command",
        NodeType.CLIENT: "call",
        NodeType.SERVICE: "serve",
        NodeType.ACTION: "act",
    }
    for kind, right in rights.items():
        for books in (*asked.values(), *heard.values()):
            books.clear()
        others = [each for each in rights.values() if each != right]
        may = door.tokens.make(f"may-{right}", may=[right], robots=[1], groups=[3], topics=["/camera/**"])
        may_not = door.tokens.make(f"may-not-{right}", may=others, robots=[1], groups=[3], topics=["/camera/**"])
        async with await door.come(port, may) as one, await door.come(port, may_not) as two:
            await until(lambda: {agent.id for agent in robots} <= set(door.gateway.directory.ids(ROS)))
            spec, other = NodeSpec(kind, "/camera/image", "pkg/T"), NodeSpec(kind, "/cmd_vel", "pkg/T")
            attempts: list[tuple[Headset, NodeSpec, list[int], list[int], bytes]] = [
                (one, other, [1], [], b"\0\1\0\0 another topic"),
                (one, spec, [2], [], b"\0\1\0\0 another robot"),
                (one, spec, [], [4], b"\0\1\0\0 another group"),
                (two, spec, [1], [], b"\0\1\0\0 no right"),
                (one, spec, [1], [], b"\0\1\0\0 by id"),
                (one, spec, [], [3], b"\0\1\0\0 by group"),
            ]
            for headset, node, ids, groups, data in attempts:
                await headset.send_frame(frames.registration(headset.id, node, ids, groups))
                if kind is not NodeType.SUBSCRIBER:
                    await headset.send_frame(frames.node_data(headset.id, node, data, ids, groups))
            await until(lambda kind=kind: (kind, "/camera/image") in asked[1])
            if kind is not NodeType.SUBSCRIBER:
                await until(lambda: len(heard[1]) == 2)
            for headset, count in ((one, 3), (two, 1)):
                reasons: set[str] = set()
                while len(reasons) < count:
                    message = await headset.receive(PATIENCE_S)
                    if message.metadata.message_manager == NodeRefused.manager:
                        reasons.add(decode_data(NodeRefused, message.data).reason)
            await asyncio.sleep(0.1)
            assert set(asked[1]) == {(kind, "/camera/image")}
            assert asked[2] == []
            assert heard[2] == []
            assert [data[5:] for _, data in heard[1]] in ([], [b"by id", b"by group"])


async def test_a_revoked_token_ends_its_connections(start_door: StartDoor) -> None:
    """Within a second, on each port, with a hundred connections; others stay."""
    door = await start_door(**NOBODY)
    lost, kept = door.tokens.make("lost"), door.tokens.make("kept")
    ports = [PORTS[number % len(PORTS)] for number in range(100)]
    async with AsyncExitStack() as stack:
        gone = [await stack.enter_async_context(await door.come(port, lost)) for port in ports]
        stays = [await stack.enter_async_context(await door.come(port, kept)) for port in PORTS]
        began = time.monotonic()
        door.tokens.revoke("lost")
        reasons = await asyncio.wait_for(asyncio.gather(*(headset.wait_ended() for headset in gone)), PATIENCE_S)
        took_s = time.monotonic() - began
        assert set(reasons) == {"this token holds no longer"}
        print(f"100 connections ended {took_s:.2f} s after their token")
        for headset in stays:
            await headset.online()
        with pytest.raises(Refused):
            await door.come("plain", lost)


async def test_changed_rights_hold_at_once(start_door: StartDoor, robots: list[Agent]) -> None:
    """A token that may do less may do less on the connections that it has, and they are told; more, likewise."""
    door = await start_door(**NOBODY)
    heard: list[bytes] = []
    robots[0].on_message(lambda message: heard.append(bytes(message.data)))
    token = door.tokens.make("anna", may=["ask"], robots=[1])
    async with await door.come("plain", token) as anna:
        await until(lambda: door.know((ROS, 1), (UNITY, anna.id)))

        async def change(may: list[str]) -> None:
            def edit(now):  # type: ignore[no-untyped-def]
                rights = Rights(may=may, robots=[1])  # type: ignore[arg-type]
                return now.with_token(Token(name="anna", rights=rights, hashes=now.named("anna").hashes)), None

            store.change(door.tokens.path, edit)
            while (message := await anna.receive(PATIENCE_S)).metadata.message_manager != AccessRefused.manager or (
                decode_data(AccessRefused, message.data).kind != "changed"
            ):
                pass

        await anna.send(b"one", to=ROS, ids=[1])
        await change(["see"])
        await anna.send(b"two", to=ROS, ids=[1])
        await change(["ask"])
        await anna.send(b"three", to=ROS, ids=[1])
        await until(lambda: b"three" in heard)
        assert heard == [b"one", b"three"]


async def test_a_token_knows_of_its_own_robots_only(start_door: StartDoor, router: str) -> None:
    """Who is online, and who leaves: of robots those that it names, by id or by group; without a token, all."""
    door = await start_door(tls_without_token="everybody")
    tokens = {
        "one": door.tokens.make("one", may=["see"], robots=[1]),
        "four": door.tokens.make("four", may=["see"], groups=[4]),
        "any": door.tokens.make("any", may=["see"], robots="any"),
        "none": door.tokens.make("none", may=["see"]),
        "without": None,
    }
    sees = {"one": [1], "four": [2], "any": [1, 2], "none": [], "without": [1, 2]}
    async with AsyncExitStack() as stack:
        headsets = {
            name: await stack.enter_async_context(await door.come("plain", token)) for name, token in tokens.items()
        }
        async with (
            join(ROS, id=1, group=3, settings=patient(router)),
            join(ROS, id=2, group=4, settings=patient(router)),
        ):
            await until(lambda: door.gateway.directory.ids(ROS) == [1, 2])
            for _ in range(2):  # an answer that is remembered is the token's own
                for name, headset in headsets.items():
                    online = await headset.online()
                    assert online.ros_agent_ids == sees[name], name
                    assert len(online.unity_agent_ids) == len(tokens)
        await until(lambda: door.gateway.directory.ids(ROS) == [])
        async with await door.come("plain") as last:
            pass  # everybody is told of all who leave in the order in which they do
        for name, headset in headsets.items():
            gone: list[tuple[int, int]] = []
            while (UNITY, last.id) not in gone:
                message = await headset.receive(PATIENCE_S)
                if message.metadata.message_manager == AgentsGone.manager:
                    agents = decode_data(AgentsGone, message.data).agents
                    gone += [(agent.agent_type, agent.agent_id) for agent in agents]
            assert sorted(gone) == [(ROS, robot) for robot in sees[name]] + [(UNITY, last.id)], name


async def test_loopback_needs_no_token_unless_it_is_said(start_door: StartDoor) -> None:
    """TLS and web want a token where others reach them, and nowhere else; the plain port where that is said."""
    door = await start_door()
    for port in ("plain", "tls", "web"):
        async with await door.come(port) as headset:
            await headset.online()
    async with await door.come("web_tls") as headset:
        assert await headset.wait_ended() == "a valid token is wanted here"


async def test_who_shows_a_token_is_judged_by_it(start_door: StartDoor, robots: list[Agent]) -> None:
    """Also where none is wanted: a wrong one is refused, and a right one gives its rights and no more."""
    door = await start_door()
    with pytest.raises(Refused):
        await door.come("plain", "macs_wrong")
    async with await door.come("plain", door.tokens.make("anna", may=["see"], robots=[1])) as anna:
        await anna.send(b"x", to=ROS, ids=[2])
        await until(lambda: anna.forbidden)


@pytest.mark.parametrize("old", ["TLSv1", "TLSv1_1"])
async def test_old_tls_is_refused(start_door: StartDoor, old: str) -> None:
    """Nothing below TLS 1.2, and nothing plain on the TLS port."""
    door = await start_door()
    context = ssl.create_default_context(cafile=door.authority)
    context.minimum_version = ssl.TLSVersion.MINIMUM_SUPPORTED
    context.maximum_version = ssl.TLSVersion[old]
    context.set_ciphers("ALL:@SECLEVEL=0")
    with pytest.raises((ssl.SSLError, OSError)):
        await asyncio.open_connection("127.0.0.1", door.gateway.listeners.tls_port, ssl=context)
    with pytest.raises(Unreachable):
        await Headset.connect("127.0.0.1", door.gateway.listeners.tls_port, handshake_timeout_s=1.0)


async def test_a_new_certificate_is_shown_without_a_restart(start_door: StartDoor, tmp_path: Path) -> None:
    """Renewed files are what the next connection sees; files that do not fit change nothing."""
    door = await start_door()
    port, way = door.way("tls")
    files = door.gateway.settings.certificate, door.gateway.settings.key
    assert files[0] is not None
    assert files[1] is not None
    Path(files[0]).write_text("no certificate")
    await asyncio.sleep(0.6)
    async with await door.come("tls") as headset:
        await headset.online()
    other = Authority(tmp_path / "other ca")
    certificate, key = other.issue("gateway")
    Path(files[1]).write_bytes(key.read_bytes())
    Path(files[0]).write_bytes(certificate.read_bytes())

    async def shown() -> bool:
        try:
            async with await Headset.connect("127.0.0.1", port, way=Way(tls=True, authority=str(other.ca))):
                return True
        except Unreachable:
            return False

    deadline = time.monotonic() + PATIENCE_S
    while not await shown():
        assert time.monotonic() < deadline
    with pytest.raises(Unreachable):
        await Headset.connect("127.0.0.1", port, way=way)


async def test_programs_keep_to_tokens(router: str, tokens: Tokens, tmp_path: Path) -> None:
    """The command line, on the loop that it uses, with two workers: a token lets in at each port, one that is made
    meanwhile as well, and its end is known to both; what is printed for programs is as it was."""
    authority = Authority(tmp_path / "ca")
    certificate, key = map(str, authority.issue("gateway"))
    tls, web = free_port(), free_port()
    ports = ["--port", "0", "--tls-port", str(tls), "--web-port", str(web), "--certificate", certificate, "--key", key]
    rules = ["--tokens", str(tokens.path), "--without-token", "nobody"]
    async with Program("gateway", "-e", router, "--workers", "2", *ports, *rules) as gateway:
        assert re.fullmatch(r"gateway on 127\.0\.0\.1:\d+", gateway.ready)
        secret = tokens.make("anna", may=["send"])
        ways = [
            [f"127.0.0.1:{gateway.port}"],
            [f"127.0.0.1:{tls}", "--ca", str(authority.ca)],
            [f"ws://127.0.0.1:{web}"],
        ]
        for way in ways:
            assert (await macs("headset", *way, "--token", secret, "online"))["ros"] == []
            code, out, errors = await ended("headset", *way, "--token", secret[:-1], "online")
            assert (code, out) == (1, "")
            assert "a valid token is wanted here" in errors
        sent = ("send", "x", "--to", "ros", "--ids", "1")
        code, out, _ = await ended("headset", *ways[0], "--token", secret, *sent)
        assert code == 1
        assert json.loads(out)["refused"] == "robot 1 is not among the robots of this token"
        anna = [await Headset.connect("127.0.0.1", gateway.port, token=secret) for _ in range(8)]
        tokens.revoke("anna")
        reasons = await asyncio.wait_for(asyncio.gather(*(headset.wait_ended() for headset in anna)), PATIENCE_S)
        assert set(reasons) == {"this token holds no longer"}
        for headset in anna:
            await headset.close()
    code, _, errors = await ended("gateway", "-e", router, "--workers", "2", "--web-port", "0")
    assert code == 2
    assert "--web-port" in errors


# -- the web port ----------------------------------------------------------------------------------------------------


def url(door: Door, path: str, scheme: str = "http") -> str:
    """An address of the web port without TLS."""
    return f"{scheme}://127.0.0.1:{door.gateway.listeners.web_port}{path}"


async def test_a_token_travels_as_subprotocol_or_cookie(start_door: StartDoor) -> None:
    """A browser, which has no headers for it, comes by either; with a wrong one it gets no WebSocket."""
    door = await start_door(**NOBODY)
    token = door.tokens.make("page", may=["see"])
    async with aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True)) as session:
        offered = (SUBPROTOCOL, TOKEN_SUBPROTOCOL + token)
        async with session.ws_connect(url(door, "/macs", "ws"), protocols=offered) as socket:
            assert socket.protocol == SUBPROTOCOL
            assert b"AgentConfigurer" in (await socket.receive_bytes())
        for wrong in (token[:-1], "x", "macs_" + "a" * 43):
            with pytest.raises(aiohttp.WSServerHandshakeError) as error:
                await session.ws_connect(url(door, "/macs", "ws"), protocols=(SUBPROTOCOL, TOKEN_SUBPROTOCOL + wrong))
            assert error.value.status == 401
        for body in ({"token": "x"}, {"token": 1}, {}, [], {"token": token[:-1]}):
            async with session.post(url(door, "/login"), json=body) as response:
                assert response.status == 401
                assert await response.json() == {"error": "a valid token is wanted here"}
                assert not response.cookies
        async with session.post(url(door, "/login"), json={"token": token}) as response:
            assert response.status == 200
            cookie = response.cookies["macs_token"]
            assert cookie["httponly"]
            assert cookie["samesite"] == "Strict"
        async with session.ws_connect(url(door, "/macs", "ws")) as socket:
            assert b"AgentConfigurer" in (await socket.receive_bytes())


async def test_a_code_is_exchanged_once(start_door: StartDoor) -> None:
    """Six digits give a token of one's own; a second time, and after five wrong ones, they give nothing."""
    door = await start_door(**NOBODY)
    door.tokens.make("anna", may=["see"])

    def pair() -> None:
        pairing = new_pairing("anna", "123456", os.urandom(32), time.time())
        store.change(door.tokens.path, lambda tokens: (tokens.with_pairing(pairing, time.time()), None))

    async with aiohttp.ClientSession() as session:

        async def exchange(code: object) -> str | None:
            async with session.post(url(door, "/pair"), json={"code": code}) as response:
                answer = json.loads(await response.read())
                assert answer.get("error", "a valid token is wanted here") == "a valid token is wanted here"
                assert response.status == (200 if "token" in answer else 401)
                return str(answer["token"]) if "token" in answer else None

        assert await exchange("123456") is None
        pair()
        token = await exchange("123456")
        assert token is not None
        async with await door.come("web", token) as headset:
            await headset.online()
        assert await exchange("123456") is None
        pair()
        for number in range(5):
            assert await exchange(f"00000{number}") is None
        assert await exchange("123456") is None


async def test_another_page_gets_no_websocket(start_door: StartDoor) -> None:
    """The origin must be the gateway's own or be listed, and the host an address or a known name."""
    door = await start_door(web_origins=["https://listed.example.org"], web_names=["hall.example.org"])
    own = f"127.0.0.1:{door.gateway.listeners.web_port}"
    async with aiohttp.ClientSession() as session:
        for headers, allowed in [
            ({}, True),
            ({"Origin": f"http://{own}"}, True),
            ({"Origin": "https://listed.example.org"}, True),
            ({"Origin": "http://evil.example"}, False),
            ({"Origin": "http://evil.example", "Host": "evil.example"}, False),
            ({"Host": "evil.example"}, False),
            ({"Host": "hall.example.org", "Origin": "https://hall.example.org"}, True),
        ]:
            if allowed:
                async with session.ws_connect(url(door, "/macs", "ws"), headers=headers):
                    pass
            else:
                with pytest.raises(aiohttp.WSServerHandshakeError) as error:
                    await session.ws_connect(url(door, "/macs", "ws"), headers=headers)
                assert error.value.status == 403


async def raw_websocket(port: int, *headers: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """A WebSocket whose bytes are in one's own hands."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    lines = [
        "GET /macs HTTP/1.1",
        f"Host: 127.0.0.1:{port}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        *headers,
    ]
    writer.write("\r\n".join([*lines, "", ""]).encode())
    assert b" 101 " in await reader.readuntil(b"\r\n\r\n")
    return reader, writer


def masked(first: int, payload: bytes, declared: int | None = None) -> bytes:
    """A client's WebSocket frame, masked with zeros; ``first`` is its first byte."""
    size = len(payload) if declared is None else declared
    if size < 126:
        return bytes([first, 0x80 | size]) + bytes(4) + payload
    if size < 1 << 16:
        return bytes([first, 0x80 | 126]) + size.to_bytes(2, "big") + bytes(4) + payload
    return bytes([first, 0x80 | 127]) + size.to_bytes(8, "big") + bytes(4) + payload


BAD_WEBSOCKETS = {
    "larger than a message may be": [masked(0x82, bytes(1 << 20) + b"xx")],
    "declared without end": [masked(0x82, b"x", declared=1 << 62)],
    "fragments without end": [masked(0x02, bytes(1 << 18)), *[masked(0x00, bytes(1 << 18))] * 5],
    "compressed": [masked(0xC2, bytes(100))],
    "text": [masked(0x81, b"hello")],
    "no such opcode": [masked(0x83, b"hello")],
    "a continuation of nothing": [masked(0x80, b"hello")],
    "a ping in pieces": [masked(0x09, b"x")],
    "a large ping": [masked(0x89, bytes(126))],
    "a flood of pings": [masked(0x89, b"x") * 1000],
    "a flood of pongs": [masked(0x8A, b"x") * 1000],
    "a flood of nothing": [masked(0x82, b"") * 1000],
    "a frame that is too large": [masked(0x82, bytes(35) + b"\xff" * 4 + bytes(61))],
}


@pytest.mark.parametrize("what", BAD_WEBSOCKETS)
async def test_a_bad_websocket_costs_its_own_connection(start_door: StartDoor, what: str) -> None:
    """Whatever comes instead of messages ends that connection, and nobody else notices."""
    door = await start_door()
    port = door.gateway.listeners.web_port
    async with await door.come("web") as neighbour:
        reader, writer = await raw_websocket(port, "Sec-WebSocket-Extensions: permessage-deflate")
        for piece in BAD_WEBSOCKETS[what]:
            writer.write(piece)
        with contextlib.suppress(ConnectionError):
            await asyncio.wait_for(reader.read(), PATIENCE_S)  # to the end
        writer.close()
        await neighbour.online()
        await until(lambda: len(door.gateway.agents) == 1)


async def test_slow_headers_get_their_time_and_no_more(start_door: StartDoor, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who sends a request a byte at a time, or nothing, or a body without end, is closed; the port stays open."""
    monkeypatch.setattr("bridge.gateway.web.REQUEST_S", 0.5)
    door = await start_door()
    port = door.gateway.listeners.web_port
    beginnings = [b"", b"GET /macs HTT", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: "]
    beginnings += [b"POST /login HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1000\r\n\r\n{"]
    ended = []

    async def slow(beginning: bytes) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(beginning)
        with contextlib.suppress(ConnectionError):
            reading = asyncio.ensure_future(reader.read())
            while not reading.done():
                writer.write(b"x")
                await asyncio.sleep(0.05)
        writer.close()
        ended.append(beginning)

    await asyncio.wait_for(asyncio.gather(*map(slow, beginnings)), PATIENCE_S)
    assert len(ended) == len(beginnings)
    async with await door.come("web") as headset:
        await headset.online()


async def test_one_address_has_so_many_http_connections(start_door: StartDoor) -> None:
    """Who opens many gets no more than its share, and each that ends makes room; WebSockets are counted elsewhere."""
    door = await start_door()
    port = door.gateway.listeners.web_port
    async with await door.come("web") as headset:
        opened = [await asyncio.open_connection("127.0.0.1", port) for _ in range(200)]
        await until(lambda: door.gateway.drops["too_many_requests"] == 200 - 128)
        for _, writer in opened:
            writer.close()
        await headset.online()
        await asyncio.sleep(0.2)
        async with await door.come("web") as other:
            await other.online()


async def test_a_robot_whose_token_makes_it_none_is_told_of(
    start_door: StartDoor, caplog: pytest.LogCaptureFixture
) -> None:
    """Its token is good for a headset: the log says that it was not let in, as of who has none."""
    door = await start_door(**NOBODY)
    reader, writer = await asyncio.open_connection("127.0.0.1", door.gateway.listeners.port)
    configuration = Configuration(ROS, 0, token=door.tokens.make("good", may=["see"]))
    writer.write(encode_frame(management=encode_management(configuration)))
    await asyncio.wait_for(reader.read(), PATIENCE_S)
    writer.close()
    await until(lambda: any("shows no valid token at the plain port" in message for message in caplog.messages))


@pytest.mark.soak
async def test_ten_thousand_attempts_leave_nothing_behind(
    start_door: StartDoor, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without, with ended, revoked, cut-off and foreign tokens: none gets in, no memory stays, and the log counts."""
    began = time.monotonic()
    monkeypatch.setattr(Churn, "FREE", 1_000_000)  # that they are greeted later and later is a test of its own
    door = await start_door(**NOBODY)
    good = door.tokens.make("good")
    wrong = [
        None,
        good[:-1],
        new_secret(os.urandom(32)),
        door.tokens.make("ended", expires_at=time.time() - 1),
        "x" * 999,
    ]
    port = door.gateway.listeners.port
    answers = set()

    async def attempt(shown: str | None) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        configuration = Configuration(UNITY, 0, token=shown)
        writer.write(encode_frame(management=encode_management(configuration)))
        everything = await reader.read()
        messages = MessageDecoder().feed(everything)
        writer.close()
        if not messages:  # a busy gateway has so many strangers of this address already
            await asyncio.sleep(0.05)
            await attempt(shown)
            return
        answers.add(bytes(split_message(messages[1])[1]))
        assert len(messages) == 2

    async def many(count: int) -> None:
        numbers = iter(range(count))

        async def in_turn() -> None:
            for number in numbers:
                await attempt(wrong[number % len(wrong)])

        await asyncio.wait_for(asyncio.gather(*(in_turn() for _ in range(50))), 4 * PATIENCE_S)

    def blocks() -> int:
        gc.collect()
        return sys.getallocatedblocks()

    await many(1_000)
    before = blocks()
    await many(9_000)
    # what the sockets of the last ones hold goes when the loop has heard of their end
    await until(lambda: blocks() - before < 2_000, every_s=0.5)
    assert answers == {encode_data(AccessRefused("no_token", "a valid token is wanted here"))}
    await until(lambda: door.gateway.drops["NotAdmitted"] == 10_000)
    print(f"10 000 attempts: {blocks() - before} blocks of memory more")
    shown = [record.getMessage() for record in caplog.records if "shows no valid token" in record.getMessage()]
    assert shown[0].startswith("127.0.0.1 shows no valid token at the plain port")
    assert len(shown) <= 2 + (time.monotonic() - began) / 60, "once a minute"
    assert not any(secret in caplog.text for secret in (good, good[:-1]))


async def test_what_is_no_request_is_answered_and_counted(
    start_door: StartDoor, caplog: pytest.LogCaptureFixture
) -> None:
    """Whatever comes to the web port gets an answer or its end; a client's faults are no errors of ours."""
    door = await start_door()
    port = door.gateway.listeners.web_port
    for data in [
        b"\x16\x03\x01garbage\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"G" * 70_000,
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\nContent-Length: 5\r\n\r\nzz",
        b"GET /nothing HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"POST /login HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99999\r\n\r\n" + bytes(99_999),
        bytes(39),
    ]:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(data)
        assert b" 40" in (await asyncio.wait_for(reader.readline(), PATIENCE_S))
        writer.close()
    assert door.gateway.drops["bad_http"] >= 2
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


FLOODS = {
    "pings": masked(0x89, b"") * 40_000,
    "fragments": masked(0x02, b"x") + masked(0x00, b"") * 40_000,
    "empty messages": masked(0x82, b"") * 40_000,
    "bytes": masked(0x82, b"\0") * 35_000,
}


@pytest.mark.parametrize("what", FLOODS)
async def test_a_flood_leaves_others_their_turn(start_door: StartDoor, what: str) -> None:
    """However small the pieces are that somebody sends, and how often he comes again: no turn of the loop takes long,
    counted in the processor's time, which other programs do not change."""
    door = await start_door()
    port = door.gateway.listeners.web_port
    stop = threading.Event()

    def flood() -> None:
        request = (
            f"GET /macs HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        ).encode()
        while not stop.is_set():
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=2) as attacker:
                attacker.sendall(request)
                attacker.recv(500)
                attacker.sendall(FLOODS[what])
                while attacker.recv(65536):
                    pass

    flooding = asyncio.create_task(asyncio.to_thread(flood))
    turns_s = []
    memory.settle()  # as gateways do; the tests' own heap takes 50 ms to go through
    gc.disable()  # nor is what other tests have left behind since looked at meanwhile
    deadline = time.monotonic() + examples(200) / 100
    began = time.thread_time()
    while time.monotonic() < deadline:
        await asyncio.sleep(0)
        now = time.thread_time()
        turns_s.append(now - began)
        began = now
    stop.set()
    gc.enable()
    gc.unfreeze()
    await flooding
    turns_s.sort()
    assert turns_s[-3] < 0.05, turns_s[-5:]  # what is done once is not what a flood costs


async def test_a_token_that_is_for_a_robot_now_ends_its_headset(start_door: StartDoor) -> None:
    """It would stay and be heard by nobody."""
    door = await start_door(**NOBODY)
    token = door.tokens.make("anna", may=["ask"], robots=[1])
    async with await door.come("plain", token) as anna:
        await until(lambda: list(door.gateway.agents.online()))

        def edit(now):  # type: ignore[no-untyped-def]
            return now.with_token(
                Token(name="anna", rights=Rights(may=["robot"]), hashes=now.named("anna").hashes)
            ), None

        store.change(door.tokens.path, edit)
        await until(lambda: not anna.connected)
        await until(lambda: not list(door.gateway.agents.online()))


@pytest.mark.parametrize("port", ["plain", "tls", "web"])
async def test_a_connection_that_ends_leaves_no_circle(start_door: StartDoor, port: str) -> None:
    """What a frame that had begun has taken is given back when its connection ends, and not some time later."""
    door = await start_door()
    number, way = door.way(port)
    gc.collect()
    gc.disable()
    try:
        stream = await open_stream("127.0.0.1", number, way)
        stream.write(frames.configuration(0, 0, 0))
        await until(lambda: list(door.gateway.agents.online()))
        (connection,) = door.gateway.agents.online()
        peer = weakref.ref(connection.peer)
        del connection
        stream.write(struct.pack("<B30xII", 2, 0, 31 << 20) + bytes(1 << 20))
        await asyncio.sleep(0.2)
        stream.abort()
        await until(lambda: peer() is None)
    finally:
        gc.enable()


@pytest.mark.parametrize("port", PORTS)
async def test_silence_is_judged_by_what_was_read(start_door: StartDoor, port: str) -> None:
    """Whom the gateway does not read from is not silent, however long; one that then says nothing more is, although
    less came out of TLS or a WebSocket than had waited in the socket."""
    door = await start_door(idle_timeout_s=1.0, web_without_token="everybody")
    gateway = door.other if port == "web_tls" else door.gateway
    async with await door.come(port, heartbeat_s=1000.0) as headset:
        await until(lambda: gateway.agents.find(UNITY, headset.id))
        connection = gateway.agents.find(UNITY, headset.id)
        assert connection is not None
        connection.pause()
        beat = encode_frame(management=b'{"messageManager":"HeartbeatHandler"}')

        async def say_much() -> None:
            with contextlib.suppress(Unreachable):
                for _ in range(2000):
                    await headset.send_frame(beat * 20)

        saying = asyncio.create_task(say_much())
        paused_at, looked = time.monotonic(), []

        async def looks() -> bool:
            looked.append(connection._looked)
            return time.monotonic() > max(paused_at, connection.peer.heard_at) + 2.0

        await until(looks)
        assert headset.connected, headset.why_ended
        assert any(looked), "its time has run out meanwhile"
        before = connection.peer.heard_at
        connection.resume()
        await until(lambda: connection.peer.heard_at > before)
        saying.cancel()
        await until(lambda: not headset.connected)
