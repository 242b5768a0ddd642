"""The Zenoh session on a real router: who gets what, in which order."""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest
import zenoh

import macs_zenoh
from bridge.gateway.server import Gateway
from bridge.headset.client import Headset
from bridge.settings import GatewaySettings
from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import MacsError, Refused
from macs_zenoh.losses import Losses
from macs_zenoh.mesh import Mesh, Sample, Traffic
from macs_zenoh.mesh.outgoing import Outgoing
from macs_zenoh.mesh.sender import Sender
from macs_zenoh.mesh.streams import Streams
from macs_zenoh.protocol.keyexpr import PING, UNICAST
from macs_zenoh.protocol.limits import CALL_BYTES
from tests.support.local import patient
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

KEY = "macs/to/unity/0/1/unity/2"
TOPIC_KEY = "macs/from/ros/7/nd__x"
LARGE = Mesh.LARGE_BYTES + 1
NOBODY: Any = None


def keeper(into: list[tuple[int, bytes]]) -> Callable[[list[Sample]], None]:
    """Keeps size and end of every sample."""
    return lambda batch: into.extend((len(payload), bytes(payload[-4:])) for _, payload in batch)


def payloads(count: int) -> list[bytes]:
    """Large and small ones in turn, numbered."""
    return [(LARGE if i % 2 == 0 else 8) * b"x" + i.to_bytes(4, "big") for i in range(count)]


async def test_large_and_small_keep_their_order_here_and_elsewhere(router: str) -> None:
    """What one program puts on a key reaches its own subscription and another program's once, in its order."""
    here: list[tuple[int, bytes]] = []
    away: list[tuple[int, bytes]] = []
    async with (
        await Mesh.open(MeshSettings(connect=[router])) as mesh,
        await Mesh.open(MeshSettings(connect=[router])) as other,
    ):
        mesh.subscribe(KEY, keeper(here))
        other.subscribe(KEY, keeper(away))
        await until(lambda: (mesh.put(KEY, b"begin"), away)[1])  # the routers know who listens
        sent = payloads(40)
        for payload in sent:
            mesh.put(KEY, payload)
        expected = [(len(payload), payload[-4:]) for payload in sent]
        await until(lambda: here[-40:] == expected and away[-40:] == expected)
        assert not mesh.drops


@pytest.mark.megabytes
async def test_a_large_command_is_put_by_a_thread_and_what_follows_it_comes_behind(
    router: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh waits for room for each of its fragments, in the loop of everybody: what this program hears of it was not
    put there. Too much at once is dropped and counted."""
    monkeypatch.setattr(Outgoing, "COMMANDS_BYTES", 4 << 20)
    monkeypatch.setattr(Outgoing, "COMMANDS_S", math.inf)
    here: list[tuple[int, bytes]] = []
    async with await Mesh.open(MeshSettings(connect=[router])) as mesh:
        mesh.subscribe(KEY, keeper(here))
        await until(lambda: mesh.linked)
        sent = payloads(40)
        for payload in sent:
            looped = mesh.looped
            mesh.put(KEY, payload, Traffic.COMMAND)
            assert len(payload) < LARGE or mesh.looped == looped
        await until(lambda: here == [(len(payload), payload[-4:]) for payload in sent])
        assert not mesh.drops
        for payload in [bytes(2 << 20)] * 40:
            mesh.put(KEY, payload, Traffic.COMMAND)
        await mesh.drain()
        await until(lambda: len(here) + mesh.drops["backlog"] == 80)
        assert mesh.drops["backlog"] > 0


@pytest.mark.megabytes
async def test_large_topic_data_of_others_is_put_by_a_thread(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of its key, with what follows it, while this program's own subscriptions get it at once. Who brings
    it is told when it is too much and when it is not; of what is more than that each is dropped and counted."""
    monkeypatch.setattr(Streams, "MOST_S", math.inf)
    here: list[tuple[int, bytes]] = []
    away: list[tuple[int, bytes]] = []
    room = asyncio.Event()
    async with (
        await Mesh.open(patient(router)) as mesh,
        await Mesh.open(patient(router)) as other,
    ):
        mesh.subscribe(TOPIC_KEY, keeper(here))
        other.subscribe(TOPIC_KEY, keeper(away))
        mesh.streams.on_room(room.set)
        await until(lambda: (mesh.streams.put(TOPIC_KEY, b"begin"), away)[1])  # the routers know who listens
        expected = [(len(payload), payload[-4:]) for payload in payloads(20)]
        for payload in payloads(20):
            mesh.streams.put(TOPIC_KEY, payload)
            await asyncio.sleep(0.02)
        await until(lambda: here[-20:] == expected and away[-20:] == expected)
        assert not mesh.drops
        assert mesh.streams.sent >= 10
        before, backlogged = len(here), False
        for payload in [bytes(2 << 20)] * 100:
            mesh.streams.put(TOPIC_KEY, payload)
            backlogged |= mesh.streams.backlogged
        assert backlogged
        await room.wait()
        await until(lambda: len(here) == before + 100)
        assert 0 < mesh.drops["backlog"] < 100


def test_what_follows_large_commands_waits_no_longer_than_it_may() -> None:
    """Large ones that have waited too long are dropped and counted; what is behind them goes on, also where there is
    no room for more large ones."""
    put: list[Any] = []
    begun, goes_on, done = threading.Event(), threading.Event(), threading.Event()
    late: list[int] = []

    def slow(_: Any, payload: Any) -> None:
        begun.set()
        goes_on.wait()
        put.append(payload)

    sender = Sender(
        2 * LARGE, slow, lambda: None, Losses(logging.getLogger("macs.mesh")), lambda: late.append(1), most_s=0.0
    )
    first, second, small = bytes(LARGE), b"2" * LARGE, b"small"
    assert sender.put(NOBODY, first, KEY)
    begun.wait()
    assert sender.put(NOBODY, second, KEY)
    assert not sender.put(NOBODY, first, KEY)
    assert sender.put(NOBODY, small, KEY)
    sender.when_sent(done.set)
    goes_on.set()
    done.wait()
    sender.close(60)
    assert put == [first, small]
    assert late == [1]


def test_what_cannot_be_put_costs_itself() -> None:
    """A fault nobody thought of, in what is put or told, is counted; all behind it goes on, and its key is free."""
    put: list[Any] = []
    goes_on, done = threading.Event(), threading.Event()

    def picky(_: Any, payload: Any) -> None:
        goes_on.wait()
        if payload == b"bad":
            raise RuntimeError("of nobody's making")
        put.append(payload)

    def fails() -> None:
        raise RuntimeError("who is told fails")

    drops = Losses(logging.getLogger("macs.mesh"))
    sender = Sender(2 * LARGE, picky, lambda: None, drops)
    for payload in (b"bad", b"good"):
        assert sender.put(NOBODY, payload, KEY)
        sender.when_sent(fails)
    sender.when_sent(done.set)
    goes_on.set()
    assert done.wait(PATIENCE_S)
    sender.close(PATIENCE_S)
    assert put == [b"good"]
    assert sender.idle
    assert not sender.has(KEY)
    assert drops["failed"] == 3


@pytest.mark.parametrize("settled", [True, False])
async def test_who_subscribes_later_gets_large_payloads(
    router: str, settled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program that begins to listen to a key on which large payloads stayed in one program gets the next ones."""
    if settled:
        monkeypatch.setattr(Outgoing, "SETTLE_S", 0.0)
    here: list[tuple[int, bytes]] = []
    away: list[tuple[int, bytes]] = []
    async with await Mesh.open(MeshSettings(connect=[router])) as mesh:
        mesh.subscribe(KEY, keeper(here))
        for payload in payloads(4):
            mesh.put(KEY, payload)
        await until(lambda: len(here) == 4)
        async with await Mesh.open(MeshSettings(connect=[router])) as other:
            other.subscribe(KEY, keeper(away))
            number = 4

            def put() -> list[tuple[int, bytes]]:
                nonlocal number
                mesh.put(KEY, LARGE * b"x" + number.to_bytes(4, "big"))
                number += 1
                return away

            await until(put)
            await until(lambda: len(here) == number)
        assert [end for _, end in here] == [i.to_bytes(4, "big") for i in range(number)]


@pytest.mark.megabytes
@pytest.mark.parametrize("size", [64, Outgoing.HERE_BYTES, 2 * Outgoing.LARGE_BYTES])
async def test_who_sends_to_many_gets_publishers_for_some_and_all_of_it_arrives(
    router: str, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh never forgets a key that had a publisher, so a sender's others have none; another sender's still have."""
    monkeypatch.setattr(Outgoing, "OF_SENDER", 16)
    keys: set[str] = set()
    here: list[tuple[int, bytes]] = []
    away: list[tuple[int, bytes]] = []
    async with (
        await Mesh.open(MeshSettings(connect=[router])) as mesh,
        await Mesh.open(MeshSettings(connect=[router])) as other,
    ):
        mesh.subscribe(UNICAST.every(type="unity"), keeper(here))
        other.subscribe(UNICAST.every(type="unity"), keeper(away))
        await until(lambda: (mesh.put(UNICAST.of(type=2, id=9, from_type=1, from_id=9), b"begin"), away)[1])

        class Counting:
            """The session, whose publishers are counted."""

            def __getattr__(self, name: str) -> Any:
                return getattr(session, name)

            def declare_publisher(self, key: str, **way: Any) -> zenoh.Publisher:
                keys.add(key)
                declared: zenoh.Publisher = session.declare_publisher(key, **way)
                return declared

        session = mesh._outgoing._session
        monkeypatch.setattr(mesh._outgoing, "_session", Counting())
        monkeypatch.setattr(mesh._outgoing._sender, "_limit_bytes", 256 << 20)  # however slow the link, all may wait
        sent = []
        for sender in (7, 8):
            for again in range(4):
                for number in range(1, 41):
                    payload = bytes(size) + f"{sender:2}{again}{number:3}".encode()
                    mesh.put(UNICAST.of(type=2, id=number, from_type=1, from_id=sender), payload)
                    sent.append((len(payload), payload[-4:]))
        await until(lambda: here[-len(sent) :] == sent and away[-len(sent) :] == sent)
        of = {sender: len([key for key in keys if key.endswith(f"/ros/{sender}")]) for sender in (7, 8)}
        assert of == {7: 16, 8: 16}


async def test_a_lost_router_costs_nothing_between_agents_of_one_program() -> None:
    """Large payloads pass between two agents of one program while there is no router."""
    here: list[tuple[int, bytes]] = []
    async with Router() as router, await Mesh.open(MeshSettings(connect=[router.endpoint])) as mesh:
        mesh.subscribe(KEY, keeper(here))
        await router.stop()
        await until(lambda: not mesh.linked)
        for payload in payloads(6):
            mesh.put(KEY, payload)
        await until(lambda: len(here) == 6)
        assert [end for _, end in here] == [i.to_bytes(4, "big") for i in range(6)]


async def test_a_flood_from_elsewhere_delays_nothing_that_agents_of_one_program_say(router: str) -> None:
    """What this program puts does not wait behind all that has come from the mesh, and is in its own order."""
    handled: list[str] = []

    def slow(batch: Iterator[Sample]) -> None:
        for _ in batch:
            handled.append("elsewhere")
            time.sleep(0.001)

    def own(batch: Iterator[Sample]) -> None:
        handled.extend(bytes(payload).decode() for _, payload in batch)

    async with (
        await Mesh.open(MeshSettings(connect=[router])) as mesh,
        await Mesh.open(MeshSettings(connect=[router])) as other,
    ):
        mesh.subscribe("test/flood", slow)
        mesh.subscribe("test/own", own)
        await until(lambda: (other.put("test/flood", b"begin"), handled)[1])
        for _ in range(1500):
            other.put("test/flood", b"x")
        await until(lambda: len(mesh._arrivals._queue) > 500)
        waiting, before = len(mesh._arrivals._queue), len(handled)
        for word in ("one", "two"):
            mesh.put("test/own", word.encode())
        await until(lambda: "two" in handled)
        since = handled[before:]
        assert since.index("one") < since.index("two")
        assert since.index("two") < waiting // 2, f"behind {since.index('two')} of {waiting} that waited"


async def test_a_sample_that_fails_costs_itself(router: str, caplog: pytest.LogCaptureFixture) -> None:
    """Samples behind one that a subscription cannot handle are handled, in order; it is counted, and told once."""
    async with await Mesh.open(MeshSettings(connect=[router])) as mesh:
        found: list[bytes] = []

        def handle(batch: Iterator[Sample]) -> None:
            for _, payload in batch:
                if payload in (b"3", b"5"):
                    raise ZeroDivisionError
                found.append(bytes(payload))

        mesh.subscribe(KEY, handle)
        for number in range(8):
            mesh.put(KEY, str(number).encode())
        await until(lambda: len(found) >= 6)
        assert found == [b"0", b"1", b"2", b"4", b"6", b"7"]
        assert mesh.drops["failed_sample"] == 2
        assert sum("counted as failed_sample" in record.getMessage() for record in caplog.records) == 1


async def test_a_zenoh_id_is_its_owners_secret(router: str) -> None:
    """Nothing that a session declares as its own has its Zenoh id in it, with which somebody else could keep it out;
    all of it has the same other one. An id that was chosen is as it was chosen."""
    async with (
        macs_zenoh.join("ros", id=7, group=3, connect=[router]) as agent,
        await Mesh.open(MeshSettings(connect=[router])) as watcher,
        await Mesh.open(MeshSettings(connect=[router], overrides=['id:"abc"'])) as chosen,
    ):
        gateway = Gateway(agent.mesh, GatewaySettings(port=0))
        await gateway.start()
        async with await Headset.connect("127.0.0.1", gateway.port):
            own = str(agent.mesh._session.zid())
            keys: list[str] = []
            while len(keys) < 3:
                keys = await watcher.tokens("macs/**")
            assert not [key for key in keys if own in key]
            assert all(agent.mesh.zid in key for key in keys)
            assert await watcher.query(PING.of(zid=agent.mesh.zid), b"", timeout_s=PATIENCE_S)
        await gateway.close()
        assert chosen.zid == "abc"


async def test_of_calls_that_no_gate_admits_so_many_wait_at_most(router: str) -> None:
    """While the loop is busy 1 024 calls wait; what is more has no answer, and is counted."""
    count = 3000

    async def answer(key: str, payload: bytes) -> bytes:
        return payload

    here = patient(router)
    async with await Mesh.open(here) as server, await Mesh.open(here) as client:
        serving = server.serve("macs/ping/here", answer)

        async def asks() -> bool:
            with suppress(MacsError):
                return await client.query("macs/ping/here", b"x", timeout_s=PATIENCE_S) == b"x"
            return False

        await until(asks)
        asking = [asyncio.ensure_future(asks()) for _ in range(count)]
        await asyncio.sleep(0)  # now all of them have asked
        deadline = time.monotonic() + PATIENCE_S
        while not server.drops["flooded"] and time.monotonic() < deadline:
            time.sleep(0.05)
        answered = sum(await asyncio.gather(*asking))
        assert 0 < count - answered == server.drops["flooded"]
        serving.close()


async def test_what_calls_bring_is_bounded(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that brings more than is read is refused unread, at once; of large ones that wait or are being answered so
    many bytes are kept, and what is more has no answer. Neither is in the way of small ones, nor they in its."""
    most = 1 << 20
    monkeypatch.setattr("macs_zenoh.mesh.calls.ASKED_BYTES", most)
    answers, read = asyncio.Event(), Counter[int]()

    async def answer(key: str, payload: bytes) -> bytes:
        read[len(payload)] += 1
        await answers.wait()
        return payload[:1]

    async def at_once(key: str, payload: bytes) -> bytes:
        return payload[:1]

    here = patient(router)
    async with await Mesh.open(here) as server, await Mesh.open(here) as client:
        serving = [server.serve("macs/ping/little", at_once, most_bytes=100), server.serve("macs/ping/much", answer)]

        async def ask(key: str, size: int) -> bytes | MacsError:
            try:
                return await client.query(key, b"x" * size, timeout_s=PATIENCE_S)
            except MacsError as error:
                return error

        async def served() -> bool:
            return isinstance(await ask("macs/ping/little", 101), Refused)

        await until(served)
        asking = [asyncio.ensure_future(ask("macs/ping/much", CALL_BYTES)) for _ in range(20)]
        await until(lambda: read[CALL_BYTES] == 20)
        large = most // 4 - 1000
        asking += [asyncio.ensure_future(ask("macs/ping/much", large)) for _ in range(10)]
        await until(lambda: read[large] == 4 and server.drops["flooded"] == 6)
        assert await ask("macs/ping/little", 100) == b"x"
        assert isinstance(await ask("macs/ping/little", 2 * most), Refused)
        answers.set()
        told = await asyncio.gather(*asking)
        assert told[:20] == [b"x"] * 20
        assert (told.count(b"x"), sum(isinstance(each, MacsError) for each in told)) == (24, 6)
        assert await ask("macs/ping/much", 2 * most) == b"x"
        assert server.drops["flooded"] == 6
        assert server.drops["too_large"] >= 2
        for each in serving:
            each.close()


async def test_what_brings_too_much_is_refused_while_the_loop_is_busy(router: str) -> None:
    """The answer is there before the loop comes to anything, and nothing of the call waits."""
    told: list[bytes] = []
    answered = threading.Event()

    async def answer(key: str, payload: bytes) -> bytes:
        return payload

    here = patient(router)
    async with await Mesh.open(here) as server, await Mesh.open(here) as client:
        serving = server.serve("macs/ping/little", answer, most_bytes=100)

        async def served() -> bool:
            with suppress(MacsError):
                return await client.query("macs/ping/little", b"x", timeout_s=PATIENCE_S) == b"x"
            return False

        await until(served)

        def on_reply(reply: zenoh.Reply) -> None:
            told.append(reply.err.payload.to_bytes() if reply.err is not None else b"")
            answered.set()

        handler = zenoh.handlers.Callback(on_reply, answered.set, indirect=False)
        client._session.get("macs/ping/little", handler, payload=b"x" * (1 << 20), timeout=PATIENCE_S)
        assert answered.wait(PATIENCE_S)  # here the loop stands
        assert len(told) == 1
        assert b"refused" in told[0]
        serving.close()


async def test_tokens_that_come_together_are_each_told_of(router: str) -> None:
    """In their order, whatever becomes of one of them, and the loop goes on in between."""
    told: list[str] = []
    ticks = 0

    def hear(key: str, alive: bool) -> None:
        told.append(f"{key} {alive}")
        if len(told) % 100 == 7:
            raise ValueError("on purpose")

    async def tick() -> None:
        nonlocal ticks
        while True:
            await asyncio.sleep(0)
            ticks += bool(told) and len(told) < 2000

    failed: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, about: failed.append(about["exception"]))
    here = patient(router)
    async with await Mesh.open(here) as watcher, await Mesh.open(here) as other:
        watching = watcher.watch_tokens("macs/name/*", hear)
        ticking = asyncio.ensure_future(tick())
        tokens = [other.declare_token(f"macs/name/{number}") for number in range(1000)]
        await until(lambda: len(told) == 1000)
        for token in tokens:
            token.close()
        await until(lambda: len(told) == 2000)
        ticking.cancel()
        for alive, part in ((True, told[:1000]), (False, told[1000:])):
            assert sorted(part) == sorted(f"macs/name/{number} {alive}" for number in range(1000))
        assert len(failed) == 20
        assert ticks > 5
        watching.close()
