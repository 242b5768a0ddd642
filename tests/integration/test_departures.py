"""Many who leave in one moment take nobody's turn, and everybody is told of each of them."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack

import pytest

from bridge.gateway import departures
from bridge.gateway.connection import Connection
from bridge.gateway.departures import Departures, Pieces
from macs_zenoh.mesh import gathered
from macs_zenoh.protocol.directory import AgentInfo
from macs_zenoh.protocol.messages import AgentsGone, decode_data
from tests.integration.test_gateway import socket
from tests.support.given import Connect, StartGateway
from tests.support.waiting import until


class Told:
    """What each of some listeners was told: ids of those who left, message by message."""

    def __init__(self, listeners: int) -> None:
        self.messages: dict[int, list[list[int]]] = {listener: [] for listener in range(listeners)}
        self.departures = Departures(lambda: list(self.messages), self.telling)  # type: ignore[arg-type, return-value]

    def telling(self, gone: list[AgentInfo]) -> Callable[[Connection], None]:
        ids = [agent.id for agent in gone]
        return lambda listener: self.messages[listener].append(ids)  # type: ignore[index]

    def ids(self, listener: int = 0) -> list[int]:
        """All of them, in order."""
        return [each for message in self.messages[listener] for each in message]


def headset(number: int) -> AgentInfo:
    return AgentInfo(2, number, 0, "a1", 0)


async def test_those_who_leave_in_a_moment_are_told_of_together_and_once() -> None:
    """The first at once, those that follow soon in one message; each listener hears of each once, in order."""
    told = Told(100)
    told.departures.tell([headset(1)], [])
    for number in range(2, 200):
        told.departures.tell([headset(number)], [])
    await until(lambda: all(told.ids(listener) == list(range(1, 200)) for listener in told.messages))
    assert len(told.messages[0]) <= 4
    told.departures.close()


async def test_who_comes_under_the_id_of_one_who_left_comes_after_that_is_known() -> None:
    """A robot program that heard of it later would let go of who is there now."""
    told = Told(1)
    told.departures.tell([headset(1)], [])
    told.departures.tell([headset(2), headset(3)], [])
    assert told.ids() == [1]
    told.departures.tell([], [(2, 9)])
    assert told.ids() == [1]
    told.departures.tell([], [(2, 3)])
    assert told.ids() == [1, 2, 3]
    told.departures.close()


async def test_work_for_many_is_done_in_pieces_and_in_order() -> None:
    """The first at once; others have their turn before all is done; what fails costs itself only. What is done once
    for several is done behind each of them, also behind one that fails."""
    done: list[int] = []
    together: list[int] = []
    turns = 0

    def work(number: int) -> None:
        done.append(number)
        until_s = asyncio.get_running_loop().time() + 0.001
        while asyncio.get_running_loop().time() < until_s:
            pass
        if number == 3:
            raise ValueError

    pieces = Pieces(work, lambda: together.append(len(done)))  # type: ignore[arg-type]
    for number in range(30):
        pieces.put(number)  # type: ignore[arg-type]
    assert done[:1] == [0]
    assert len(done) < 30
    asyncio.get_running_loop().set_exception_handler(lambda loop, context: None)
    while len(done) < 30:
        await asyncio.sleep(0)
        turns += 1
    assert done == list(range(30))
    assert turns >= 5
    assert together[0] == 1
    assert together[-1] == 30
    assert 4 in together


async def test_those_that_are_seen_leave_at_a_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    """So many at once, the others in their order, so many each time, first those that are needed; who is not seen does
    not wait; in the end all are hurried."""
    monkeypatch.setattr(departures, "EVERY_S", 0.05)
    done: list[int] = []
    pieces = Pieces(done.append, lambda: None)  # type: ignore[arg-type]
    for number in range(20):
        pieces.put(number, seen=True)  # type: ignore[arg-type]
    pieces.put(100, seen=True, first=True)  # type: ignore[arg-type]
    pieces.put(200)  # type: ignore[arg-type]
    await until(lambda: 200 in done)
    assert len(done) < 20
    await until(lambda: len(done) > 15)
    assert done.index(100) <= departures.AT_ONCE + 1
    assert [number for number in done if number < 100] == list(range(len(done) - 2))
    for number in range(20, 40):
        pieces.put(number, seen=True)  # type: ignore[arg-type]
    pieces.hurry()
    pieces.put(40, seen=True)  # type: ignore[arg-type]
    pieces.finish()
    assert [number for number in done if number < 100] == list(range(41))


async def test_who_leaves_before_others_see_it_is_never_seen(
    start_gateway: StartGateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody on the mesh needs to know of it. Agents here may know of it, and are told that it is gone."""
    monkeypatch.setattr(gathered, "GATHER_S", 3600.0)
    gateway = await start_gateway()
    seen: list[AgentInfo] = []
    tell = gateway._tell
    monkeypatch.setattr(
        gateway._presence, "_on_changes", lambda changes: (seen.extend(c.agent for c in changes), tell(changes))
    )
    async with socket(gateway) as stays:
        stays.configure()
        await until(lambda: [agent.id for agent in seen] == [stays.id])
        async with socket(gateway) as goes:
            goes.configure()
            await until(lambda: len(list(gateway.agents.online())) == 2)
            assert (await stays.online())[1] == sorted([stays.id, goes.id])
        metadata, body = await stays.message()
        assert metadata.message_manager == AgentsGone.manager
        assert [agent.agent_id for agent in decode_data(AgentsGone, body).agents] == [goes.id]
        assert (await stays.online())[1] == [stays.id]
        async with socket(gateway) as speaks:
            speaks.configure()
            assert speaks.id in (await speaks.online())[1]
        await until(lambda: speaks.id in [agent.id for agent in seen])
        assert goes.id not in [agent.id for agent in seen]


async def test_who_has_left_is_told_of_nobody(
    start_gateway: StartGateway, connect: Connect, crowd: AsyncExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hundred whose sockets end in one moment are forgotten one after the other; none is told of those before."""
    gateway = await start_gateway()
    for _ in range(100):
        (await crowd.enter_async_context(socket(gateway))).configure()
    await until(lambda: len(list(gateway.agents.online())) == 100)
    told: list[Connection] = []
    monkeypatch.setattr(Connection, "send_call", lambda connection, message: told.append(connection))
    for connection in gateway.agents.connections():
        connection.abort()
    await until(lambda: len(gateway.agents) == 0)
    await until(lambda: not gateway.directory.ids(2))
    assert not told


@pytest.fixture
async def crowd() -> AsyncIterator[AsyncExitStack]:
    async with AsyncExitStack() as stack:
        yield stack


async def test_everybody_hears_of_a_hundred_who_leave_together(
    start_gateway: StartGateway, connect: Connect, crowd: AsyncExitStack
) -> None:
    """On real sockets, each ended at once; who stays is told of all of them, and nobody else is online."""
    gateway = await start_gateway()
    async with socket(gateway) as stays:
        stays.configure()
        many = [await crowd.enter_async_context(socket(gateway)) for _ in range(100)]
        for one in many:
            one.configure()
        await until(lambda: len(list(gateway.agents.online())) == 101)
        ids = {one.id for one in many}
        for one in many:
            one.writer.transport.abort()
        gone: set[int] = set()
        while gone != ids:
            metadata, body = await stays.message()
            if metadata.message_manager == AgentsGone.manager:
                gone |= {agent.agent_id for agent in decode_data(AgentsGone, body).agents}
        await until(lambda: len(gateway.agents) == 1)
        assert (await stays.online())[1] == [stays.id]
