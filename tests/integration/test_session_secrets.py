"""Who tries to come in by another agent's session: ten thousand times, on every port, awake and asleep."""

from __future__ import annotations

import asyncio
import gc
import json
import logging
import os
import sys
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from bridge.gateway import Gateway
from bridge.gateway.admission import Churn
from bridge.headset import frames
from bridge.headset.client import Headset
from bridge.headset.stream import Way, open_stream
from bridge.tokens import store
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.messages import UNITY, AccessRefused, Metadata, SessionOpened, SessionResumed, encode_data
from macs_zenoh.protocol.rights import Rights
from macs_zenoh.protocol.sessions import SECRET_BYTES
from macs_zenoh.protocol.sessions import new_secret as new_session
from macs_zenoh.protocol.tokens import Token, hash_of, new_secret
from macs_zenoh.protocol.wire import split_message
from tests.support.certificates import Authority
from tests.support.gateways import way_in
from tests.support.given import StartGateway
from tests.support.waiting import PATIENCE_S, until

NOBODY = {"plain_without_token": "nobody", "tls_without_token": "nobody", "web_without_token": "nobody"}
PORTS = ("plain", "tls", "web")


class Scene:
    """A gateway with all its ports, two tokens, and headsets of the first that somebody else would like to be."""

    def __init__(self, gateway: Gateway, authority: str, path: Path) -> None:
        self.gateway = gateway
        self.authority = authority
        self._path = path
        self.anna, self.bert = self._token("anna"), self._token("bert")
        self.answers: Counter[bytes] = Counter()
        """What those are told who show no token."""
        self.seen: Counter[tuple[str, ...]] = Counter()
        """What all others are told first: the message's name, and the names and sizes of what is in it."""
        self.owned: set[int] = set()
        """Ids of the headsets that others would like to be."""
        self.taken = 0
        """How often somebody else has got one of these."""

    def _token(self, name: str) -> str:
        secret = new_secret(os.urandom(32))
        token = Token(name=name, rights=Rights(may=["see"]), hashes=[hash_of(secret)])
        store.change(self._path, lambda tokens: (tokens.with_token(token), None))
        return secret

    def way(self, port: str) -> tuple[int, Way]:
        """How the gateway is reached there."""
        return way_in(self.gateway, port, self.authority)

    async def owner(self) -> tuple[Headset, str]:
        """A headset with the first token, and the secret of its session."""
        headset = await Headset.connect("127.0.0.1", self.gateway.port, reconnect=True, token=self.anna)
        await until(lambda: headset._session is not None and headset._session.secret)
        assert headset._session is not None
        return headset, headset._session.secret

    async def attempt(self, port: str, token: str | None, secret: str) -> None:
        """Show it, hear the answer, and say goodbye, as who would be let in as the owner could."""
        number, way = self.way(port)
        stream = await open_stream("127.0.0.1", number, way)
        try:
            stream.write(frames.configuration(0, 0, 1, 1, token, secret))
            decoder, messages = MessageDecoder(), list[bytes]()
            while len(messages) < 2 and (data := await stream.read()):
                messages += decoder.feed(data)
            metadata, raw = split_message(messages[1])
            manager = Metadata.decode(metadata).message_manager
            if manager == AccessRefused.manager:
                self.answers[bytes(raw)] += 1
                return
            told = json.loads(bytes(raw))
            self.seen[(manager, *(f"{name} {len(str(value))}" for name, value in sorted(told.items())))] += 1
            given = [json.loads(bytes(split_message(messages[0])[1]))["agentId"], told.get("agentId")]
            self.taken += not self.owned.isdisjoint(given)
            stream.write(frames.go_offline(0))
            while await stream.read():
                pass
        finally:
            stream.abort()


StartScene = Callable[..., Awaitable[Scene]]


@pytest.fixture
async def start_scene(start_gateway: StartGateway, tmp_path: Path) -> StartScene:
    """Starts one."""
    authority = Authority(tmp_path / "ca")
    certificate, key = authority.issue("gateway")

    async def start(**settings: object) -> Scene:
        path = tmp_path / "tokens.json"
        said = {"tokens_file": str(path), "certificate": str(certificate), "key": str(key), **NOBODY, **settings}
        return Scene(await start_gateway(tls_port=0, web_port=0, **said), str(authority.ca), path)

    return start


def mutated(secret: str, number: int) -> str:
    """One character is another one, one is missing, one is too many, or the letters are the other way."""
    at = number // 4 % len(secret)
    other = "A" if secret[at] != "A" else "B"
    return (
        f"{secret[:at]}{other}{secret[at + 1 :]}",
        secret[:at] + secret[at + 1 :],
        f"{secret[:at]}{other}{secret[at:]}",
        secret.swapcase(),
    )[number % 4]


async def try_them_all(scene: Scene, count: int, secrets: list[str], begin: int = 0) -> int:
    """So many attempts, by all ports, fifty at once; how many of them showed a token."""
    numbers, with_token = iter(range(begin, begin + count)), 0

    async def in_turn() -> None:
        nonlocal with_token
        for number in numbers:
            secret = secrets[number % len(secrets)]
            kind = number // len(secrets) % 6
            shown, token = (
                (secret, scene.bert),  # a foreign one
                (secret[: number % len(secret)] or "A", scene.anna),  # cut off
                (mutated(secret, number), scene.anna),
                (new_session(os.urandom(SECRET_BYTES)), scene.anna),
                (secret, None),
                (secret, scene.anna[:-1]),
            )[kind]
            with_token += kind < 4
            # one in twenty by TLS and one by WebSocket, whose greetings take longer than the rest together
            port = PORTS[max(0, number % 20 - 17)]
            await scene.attempt(port, token, shown)

    await asyncio.wait_for(asyncio.gather(*(in_turn() for _ in range(20))), 240)
    return with_token


async def come_back(scene: Scene, secret: str) -> int:
    """As the owner of a session that is asleep, hear all that waits, and fall asleep again; its id."""
    stream = await open_stream("127.0.0.1", scene.gateway.port, Way())
    stream.write(frames.configuration(0, 0, 1, 1, scene.anna, secret, 1_000_000))
    decoder, messages = MessageDecoder(), list[bytes]()
    while len(messages) < 2:
        messages += decoder.feed(await stream.read())
    metadata, data = split_message(messages[1])
    assert Metadata.decode(metadata).message_manager == SessionResumed.manager
    own_id = int(json.loads(bytes(data))["agentId"])
    stream.write(frames.online_request(own_id, 5))
    while not any(b"unityAgentIds" in bytes(message) for message in messages):  # news may come behind it
        messages += decoder.feed(await stream.read())
    stream.abort()
    await until(lambda: len(scene.gateway._sleepers) == 1)
    return own_id


async def held(scene: Scene, awake: Headset, asleep: str) -> int:
    """The blocks of memory in use when the owners have heard who has left: what waits of that is bounded."""
    await until(lambda: len(scene.gateway.agents.ids) == 2)
    for _ in range(2):  # the second time says that what came the first time has arrived
        await come_back(scene, asleep)
    # what the gateway keeps for the one that is awake goes when that has said that it has come, once a second
    session = awake._session
    assert session is not None
    await until(lambda: session.told >= session.received)
    while awake.waiting:
        await awake.receive(PATIENCE_S)
    gc.collect()
    return sys.getallocatedblocks()


@pytest.mark.parametrize(
    "count", [1_000, pytest.param(10_000, marks=[pytest.mark.soak, pytest.mark.alone, pytest.mark.timeout(900)])]
)
async def test_nobody_comes_in_by_anothers_session(
    start_scene: StartScene, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """With a foreign token, cut off, changed, made up or without a token: nobody is the owner, whether that is awake
    or asleep; all are told the same; nothing of it stays; it is counted, and said with the address."""
    monkeypatch.setattr(Churn, "FREE", 1_000_000)  # that they are greeted later and later is a test of its own
    caplog.set_level(logging.WARNING)
    scene = await start_scene(resume_s=600.0)  # ten thousand take a busy machine minutes
    gateway = scene.gateway
    began = time.monotonic()
    (awake, one), (asleep, other) = await scene.owner(), await scene.owner()
    sleeper = asleep.id
    await asleep.abort()
    await until(lambda: len(gateway._sleepers) == 1)
    scene.owned = owned = {awake.id, sleeper}
    secrets = [one, other]
    try:
        before_count = count // 4
        tried = await try_them_all(scene, before_count, secrets)
        settling = count // 10
        tried += await try_them_all(scene, settling, secrets, before_count)
        before = await held(scene, awake, other)
        tried += await try_them_all(scene, count - before_count - settling, secrets, before_count + settling)
        more = 0

        async def is_little() -> bool:
            nonlocal more
            more = await held(scene, awake, other) - before
            # news of who has left that waits for the owners, and ids of blocks that are leased by now: hundreds each
            return more < 2_000 + count // 5

        await until(is_little, every_s=0.5)  # what the last sockets hold goes when the loop has heard of their end
        print(f"{count} attempts in {time.monotonic() - began:.0f} s: {more} blocks more")
        assert len(scene.seen) == 1, scene.seen
        assert next(iter(scene.seen))[0] == SessionOpened.manager
        assert scene.seen.total() == tried
        assert scene.answers == {encode_data(AccessRefused("no_token", "a valid token is wanted here")): count - tried}
        assert scene.taken == 0
        assert len(gateway._sleepers) == 1
        assert len(gateway._sleepers._sessions) == 2
        await until(lambda: gateway.drops["not_resumed"] == tried)
        assert gateway.drops["NotAdmitted"] == count - tried
        shown = [message for message in caplog.messages if message.startswith("127.0.0.1 shows no ")]
        assert shown, "the log names the address"
        assert len(shown) <= 2 + (time.monotonic() - began) / 60, "once a minute, with how often"
        assert not [message for message in caplog.messages if one in message or other in message]
        # the owners notice nothing: one is there, the other comes back as the same
        assert (await awake.online(PATIENCE_S)).unity_agent_ids == sorted(owned)
        assert await come_back(scene, other) == sleeper
    finally:
        await awake.close()


async def test_who_leaves_sleepers_behind_fills_no_more_than_its_share(
    start_scene: StartScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Attempts that end without a word leave agents asleep, of one address so many and no more; who tried from
    elsewhere still sleeps."""
    monkeypatch.setattr("bridge.gateway.sleepers.ASLEEP_PER_ADDRESS", 10)
    scene = await start_scene()
    owner, secret = await scene.owner()
    async with owner:
        for _ in range(30):
            stream = await open_stream("127.0.0.1", scene.gateway.port, Way())
            stream.write(frames.configuration(0, 0, 1, 1, scene.bert, secret))
            decoder, messages = MessageDecoder(), list[bytes]()
            while len(messages) < 2:
                messages += decoder.feed(await stream.read())
            stream.abort()
        await until(lambda: len(scene.gateway.agents) == 11)
        assert len(scene.gateway._sleepers) == 10
        assert scene.gateway.drops["not_kept"] == 20
        assert scene.gateway.agents.find(UNITY, owner.id) is not None
        await owner.online(PATIENCE_S)
