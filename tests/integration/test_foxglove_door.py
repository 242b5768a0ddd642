"""The door of a Foxglove server: whose page may come, by which token, and what that permits."""

from __future__ import annotations

import asyncio
import json
import os
import ssl
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import aiohttp
import pytest

pytest.importorskip("foxglove", reason="needs the extra foxglove: pip install 'macs-zenoh[foxglove]'")

import macs_zenoh
from bridge.foxglove import relay as door
from bridge.foxglove.live import Live
from bridge.foxglove.relay import TEXT_BYTES, Relay, own_certificate
from bridge.recording.recorder import Wanted
from bridge.tokens import store
from bridge.tokens.watch import Watch
from macs_zenoh.protocol.messages import AddNode, decode_data
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from tests.support.routers import Router
from tests.support.waiting import until

SUBPROTOCOL = "foxglove.sdk.v1"
SECRET = "/a-secret"


class Robot:
    """Robot 7, which keeps who registers and what comes."""

    def __init__(self, agent: macs_zenoh.Agent) -> None:
        self.registered: list[str] = []
        self.commands: list[bytes] = []
        agent.serve("add_node", self._add)
        agent.serve("remove_node", self._done)
        agent.on_message(lambda message: self.commands.append(bytes(message.data)))

    async def _add(self, call: macs_zenoh.Call) -> bytes:
        self.registered.append(decode_data(AddNode, call.data).tos_name)
        return b"{}"

    async def _done(self, _: Any) -> bytes:
        return b"{}"


class Site:
    """A server with its door, tokens, and a robot."""

    def __init__(self, robot: Robot, tokens: Path, live: Live, inside: int, secret: str | None) -> None:
        self.robot = robot
        self.tokens = tokens
        self.live = live
        self.inside = inside
        self.secret = secret
        self.relay: Relay
        self.port = 0

    def token(self, name: str, **rights: Any) -> str:
        secret = new_secret(os.urandom(32))
        token = Token(name=name, rights=Rights(**rights), hashes=[hash_of(secret)])
        store.change(self.tokens, lambda known: (known.with_token(token), None))
        return secret

    @asynccontextmanager
    async def client(self, token: str = "", port: int = 0, **options: Any) -> AsyncIterator[Any]:
        path = f"/?token={token}" if token else "/"
        scheme = "wss" if "ssl" in options else "ws"
        async with (
            aiohttp.ClientSession() as session,
            session.ws_connect(
                f"{scheme}://127.0.0.1:{port or self.port}{path}", protocols=[SUBPROTOCOL], **options
            ) as socket,
        ):
            yield socket

    async def status(self, token: str = "", **options: Any) -> int:
        """What who comes so is told."""
        try:
            async with self.client(token, **options):
                return 101
        except aiohttp.WSServerHandshakeError as error:
            return error.status


@asynccontextmanager
async def started(tmp_path: Path, *, publish: bool, with_tokens: bool) -> AsyncIterator[Site]:
    certificate, key, context = own_certificate()
    tokens = tmp_path / "tokens.json"
    async with (
        Router() as router,
        macs_zenoh.join("ros", id=7, connect=[router.endpoint]) as ros,
        macs_zenoh.join("unity", connect=[router.endpoint]) as agent,
    ):
        secret = SECRET if publish else None
        live = Live(agent, Wanted(frozenset({7})), secret=secret)
        site = Site(Robot(ros), tokens, live, 0, secret)
        site.inside = live.start("127.0.0.1", 0, tls_cert=certificate, tls_key=key)
        watch = Watch(tokens, lambda: relay.look()) if with_tokens else None
        relay = Relay(
            site.inside, context, secret, tokens=watch, origins=["https://app.example"], names=["hall"], robots={7}
        )
        site.relay = relay
        site.port = await relay.open("127.0.0.1", 0, None)
        if watch is not None:
            watch.start()
        await until(lambda: (1, 7) in agent.directory)
        try:
            yield site
        finally:
            if watch is not None:
                watch.close()
            await relay.close()
            live.close()


async def said(socket: Any, *ops: str) -> dict[str, Any]:
    """The next thing that the server says of this kind."""
    while True:
        message = await asyncio.wait_for(socket.receive(), 60)
        assert message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY), message
        if message.type == aiohttp.WSMsgType.TEXT and (told := json.loads(message.data))["op"] in ops:
            return dict(told)


def channel(number: int, topic: str) -> dict[str, Any]:
    return {"id": number, "topic": topic, "encoding": "cdr", "schemaName": "geometry_msgs/msg/Twist"}


def published(number: int, data: bytes) -> bytes:
    return b"\x01" + struct.pack("<I", number) + b"\0\1\0\0" + data


async def test_pages_from_elsewhere_are_refused(tmp_path: Path) -> None:
    """A page that is not listed, and one that calls this machine by a name that is not its own; programs and listed
    pages are let in."""
    async with started(tmp_path, publish=False, with_tokens=False) as site:
        assert await site.status(headers={"Origin": "http://evil.example"}) == 403
        assert await site.status(headers={"Origin": "null"}) == 403
        assert await site.status(headers={"Host": "evil.example"}) == 403
        assert await site.status(headers={"Host": "hall", "Origin": "https://app.example"}) == 101
        assert await site.status() == 101


async def test_a_token_is_wanted_and_judged(tmp_path: Path) -> None:
    """None, a wrong one, one for another robot, without the right to see, or for some topics only: refused."""
    async with started(tmp_path, publish=False, with_tokens=True) as site:
        good = site.token("good", may=["see"], robots=[7])
        few = site.token("few", may=["see"], robots=[7], topics=["/camera/**"])
        other, blind = site.token("other", may=["see"], robots=[8]), site.token("blind", may=["command"], robots="any")
        await until(lambda: _status(site, good), every_s=0.1)
        assert [await site.status(token) for token in ("", "macs_wrong")] == [401, 401]
        assert [await site.status(token) for token in (other, blind, few)] == [403, 403, 403]
        assert await site.status(headers={"Authorization": f"Bearer {good}"}) == 101
        async with site.client(good) as socket:
            assert (await said(socket, "serverInfo"))["name"] == "macs-zenoh"
            store.change(site.tokens, lambda known: (known.without("good"), None))
            while (message := await asyncio.wait_for(socket.receive(), 60)).type != aiohttp.WSMsgType.CLOSE:
                assert message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY)
            assert message.data == 4001


async def _status(site: Site, token: str) -> bool:
    return await site.status(token) == 101


async def test_what_is_published_needs_the_right(tmp_path: Path) -> None:
    """By a token for /cmd_vel: that goes to the robot; another topic, another robot and the emergency stop do not, and
    the client is told; nor what is sent on a number that was refused."""
    async with started(tmp_path, publish=True, with_tokens=True) as site:
        token = site.token("anna", may=["see", "command"], robots=[7])
        await until(lambda: _status(site, token), every_s=0.1)
        async with site.client(token) as socket:
            topics = ["/7/cmd_vel", "/8/cmd_vel", "/7/emergency_stop", SECRET]
            channels = [channel(number, topic) for number, topic in enumerate(topics, 1)]
            await socket.send_str(json.dumps({"op": "advertise", "channels": channels}))
            refused = [(await said(socket, "status"))["message"] for _ in range(3)]
            assert ["robot 8" in refused[0], "to stop" in refused[1], "no robot" in refused[2]] == [True] * 3

            async def arrived() -> bool:
                for number in range(1, 5):
                    await socket.send_bytes(published(number, b"of %d" % number))
                return bool(site.robot.commands)

            await until(arrived, every_s=0.1)
            assert set(site.robot.commands) == {b"\0\1\0\0of 1"}
            assert set(site.robot.registered) == {"/cmd_vel"}


@pytest.mark.parametrize("rights", [["see"], ["see", "call"]])
async def test_who_may_only_see_publishes_nothing(tmp_path: Path, rights: list[str]) -> None:
    """Nothing is registered with the robot."""
    async with started(tmp_path, publish=True, with_tokens=True) as site:
        token = site.token("wall", may=rights, robots="any")
        await until(lambda: _status(site, token), every_s=0.1)
        async with site.client(token) as socket:
            await socket.send_str(json.dumps({"op": "advertise", "channels": [channel(1, "/7/cmd_vel")]}))
            await socket.send_bytes(published(1, b"x"))
            assert "right to command" in (await said(socket, "status"))["message"]
            call = b"\x02" + struct.pack("<III", 1, 9, 3) + b"cdr"
            await socket.send_bytes(call)
            assert (await said(socket, "serviceCallFailure"))["callId"] == 9
        assert site.robot.registered == []


async def test_past_the_door_nothing_is_moved(tmp_path: Path) -> None:
    """A program of this machine finds the server behind it: no browser takes its certificate, and what it publishes
    there counts for nothing, though the server lets it."""
    async with started(tmp_path, publish=True, with_tokens=True) as site:
        with pytest.raises(aiohttp.ClientConnectorCertificateError):
            async with site.client(port=site.inside, ssl=ssl.create_default_context()):
                pass
        anyhow = ssl.create_default_context()
        anyhow.check_hostname, anyhow.verify_mode = False, ssl.CERT_NONE
        async with site.client(port=site.inside, ssl=anyhow) as socket:
            await said(socket, "serverInfo")
            await socket.send_str(json.dumps({"op": "advertise", "channels": [channel(1, "/7/cmd_vel")]}))
            for _ in range(5):
                await socket.send_bytes(published(1, b"x"))
            advertised = await said(socket, "advertise")
            number = advertised["channels"][0]["id"]
            subscription = {"id": 1, "channelId": number}
            await socket.send_str(json.dumps({"op": "subscribe", "subscriptions": [subscription]}))
            await socket.send_str("no json")  # it is told that this is none: all before it has been read
            await said(socket, "status")
        assert site.robot.registered == []


async def test_bad_input_costs_that_message(tmp_path: Path) -> None:
    """What is no JSON, no object, of an unknown kind, without numbers: the client goes on."""
    async with started(tmp_path, publish=True, with_tokens=False) as site, site.client() as socket:
        for text in (
            "",
            "[",
            "1",
            "[]",
            '{"op": 1}',
            '{"op": []}',
            '{"op": {"a": 1}}',
            '{"op": "subscribe", "x": ["%s"]}' % ("x" * TEXT_BYTES),
            '{"op": "advertise", "channels": [%s]}' % ("[]," * 80_000 + "1"),
        ):
            await socket.send_str(text)
            assert (await said(socket, "status"))["message"]
        for text in ('{"op": "advertise"}', '{"op": "advertise", "channels": [1, {}]}'):
            await socket.send_str(text)
        await socket.send_str('{"op": "unadvertise", "channelIds": [[1]]}')
        for text in ('{"op": "setParameters"}', "[" * 100_000):
            await socket.send_str(text)
            assert (await said(socket, "status"))["message"]
        for data in (b"", b"\x01", b"\x02\x00", b"\xff" * 100, published(77, b"")):
            await socket.send_bytes(data)
        await socket.send_str(json.dumps({"op": "advertise", "channels": [channel(1, "/7/cmd_vel")]}))

        async def arrived() -> bool:
            await socket.send_bytes(published(1, b"good"))
            return bool(site.robot.commands)

        await until(arrived, every_s=0.1)
        assert set(site.robot.commands) == {b"\0\1\0\0good"}


async def test_somebody_looks_at_thousands_of_channels_at_once(tmp_path: Path) -> None:
    """What has so many keys is passed on, and what is too much is dropped, counted, and told."""
    async with started(tmp_path, publish=False, with_tokens=False) as site, site.client() as socket:
        many = [{"id": number, "channelId": 100_000 + number} for number in range(2048)]
        # that it has no such channel the SDK says of each, and so often it may not: it reads the first one alone
        await socket.send_str(json.dumps({"op": "subscribe", "subscriptions": many[:1], "others": many[1:]}))
        assert "100000" in (await said(socket, "status"))["message"]
        assert site.relay.drops == {}
        await socket.send_str(json.dumps({"op": "subscribe", "subscriptions": many * 20}))
        assert "this is dropped" in (await said(socket, "status"))["message"]
        assert site.relay.drops == {"bad_json": 1}


async def test_what_is_too_much_to_publish_to_is_told_and_counted(tmp_path: Path) -> None:
    """Each of a message's channels beyond those that a client may have, also beyond those that are read of it; and
    what is published to them."""
    async with started(tmp_path, publish=True, with_tokens=False) as site, site.client() as socket:
        many = [channel(number, f"/7/topic{number}") for number in range(2000)]
        many[0]["id"] = "no number"
        await socket.send_str(json.dumps({"op": "advertise", "channels": many}))
        while "channels more" not in (status := await said(socket, "status"))["message"]:
            pass
        assert status["message"].startswith(f"{2000 - door.AT_ONCE} channels more")
        assert site.relay.drops == {"client_not_allowed": 2000 - door.CHANNELS}
        await socket.send_bytes(published(1999, b"x"))
        await until(lambda: site.relay.drops["not_advertised"] == 1)


async def test_who_floods_is_closed(tmp_path: Path) -> None:
    """What waits of a flood would be carried out late; whoever else publishes goes on."""
    async with (
        started(tmp_path, publish=True, with_tokens=False) as site,
        site.client() as good,
        site.client() as flooding,
    ):
        await good.send_str(json.dumps({"op": "advertise", "channels": [channel(1, "/7/cmd_vel")]}))

        async def flood() -> None:
            with suppress(ConnectionError):
                while not flooding.closed:
                    await flooding.send_bytes(published(1, b"bad"))

        task = asyncio.ensure_future(flood())
        while (message := await asyncio.wait_for(flooding.receive(), 60)).type != aiohttp.WSMsgType.CLOSE:
            assert message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY), message
        assert message.data == aiohttp.WSCloseCode.POLICY_VIOLATION
        await asyncio.wait_for(task, 60)

        async def arrived() -> bool:
            await good.send_bytes(published(1, b"good"))
            return bool(site.robot.commands)

        await until(arrived, every_s=0.1)
        assert set(site.robot.commands) == {b"\0\1\0\0good"}


async def test_one_address_does_not_take_all_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who comes from elsewhere finds one."""
    monkeypatch.setattr(door, "CLIENTS_PER_ADDRESS", 2)
    async with started(tmp_path, publish=False, with_tokens=False) as site, site.client(), site.client():
        assert await site.status() == 503
        assert site.relay.drops == {"too_many_from_address": 1}
        elsewhere = aiohttp.TCPConnector(local_addr=("127.0.0.2", 0))
        async with (
            aiohttp.ClientSession(connector=elsewhere) as session,
            session.ws_connect(f"ws://127.0.0.1:{site.port}/", protocols=[SUBPROTOCOL]) as socket,
        ):
            assert (await said(socket, "serverInfo"))["name"] == "macs-zenoh"
