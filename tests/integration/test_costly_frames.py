"""Frames that cost much are handled in turns: nobody waits for all that another one's socket brought at once."""

from __future__ import annotations

import asyncio
import socket
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import ExitStack, asynccontextmanager, suppress
from itertools import chain

import pytest

from bridge.gateway.connection import Connection
from bridge.gateway.memory import Memory
from bridge.gateway.shares import LATE_READ_BYTES, LITTLE_HAD_S, OVER_READ_BYTES, TURN_S, Rounds, Share
from macs_zenoh.protocol.kept import Kept, Room
from macs_zenoh.protocol.messages import (
    ROS,
    UNITY,
    Configuration,
    GoOffline,
    Metadata,
    OnlineRequest,
    encode_management,
)
from macs_zenoh.protocol.tcp_agent import AskedOnline, Event, Joined, Sent, State, TcpAgent
from macs_zenoh.protocol.wire import Frames, encode_frame, encode_message
from tests.support.waiting import until

MANY = 60
"""So few that one read brings them all."""
COSTS_S = TURN_S / 3


class Busy:
    """A gateway to which each question is work; ``did`` has what it was asked, by whom."""

    def __init__(self) -> None:
        self.did: list[tuple[int, str | int]] = []
        self.on_first: Callable[[], None] = lambda: None
        self.came = 0
        self.connections: list[Connection] = []
        self.robots_may_come = True

    def opened(self, connection: Connection) -> bool:
        self.came += 1
        self.connections.append(connection)
        connection.greet(TcpAgent(self.came, self.came, time.monotonic()))
        return True

    def handle(self, connection: Connection, event: Event) -> None:
        if isinstance(event, Joined):
            if event.agent_type == ROS and not self.robots_may_come:
                connection.close("no robot may come")
            return
        assert isinstance(event, AskedOnline)
        self.did.append((connection.agent_id, event.request_id))
        if event.request_id == 1:
            self.on_first()
        until_s = time.monotonic() + COSTS_S
        while time.monotonic() < until_s:
            pass

    def forward(self, connection: Connection, sent: Sent) -> None:
        self.did.append((connection.agent_id, sent.metadata.node_name))

    def closed(self, connection: Connection) -> None:
        self.did.append((connection.agent_id, "closed"))

    def sleeps(self, connection: Connection) -> bool:
        if connection.returns:
            self.did.append((connection.agent_id, "asleep"))
            connection.fall_asleep()
        return connection.asleep

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *args: None


def question(number: int) -> bytes:
    """One that a gateway answers, and for which this one works."""
    message = encode_message(Metadata(request_id=number).encode(), b"")
    return encode_frame(management=encode_management(OnlineRequest()), message=message)


def said(node: str) -> bytes:
    """A message to a robot."""
    return encode_frame(ROS, [7], message=encode_message(Metadata(node_name=node).encode(), b"x"))


@asynccontextmanager
async def two(
    busy: Busy, *, configured: bool = True, write_timeout_s: float = 30.0
) -> AsyncIterator[tuple[socket.socket, socket.socket]]:
    """Two headsets' sockets, whose connections are configured unless otherwise said."""

    memory = Memory(64 << 20, 32 << 20)
    async with many(busy, memory, 2, configured=configured, write_timeout_s=write_timeout_s) as (one, other):
        yield one, other


@asynccontextmanager
async def many(
    busy: Busy, memory: Memory, count: int, *, configured: bool = True, write_timeout_s: float = 30.0
) -> AsyncIterator[list[socket.socket]]:
    """The same of so many."""

    def make() -> Connection:
        return Connection(busy, memory=memory, outbox_bytes=64 << 20, write_timeout_s=write_timeout_s)  # type: ignore[arg-type]

    server = await asyncio.get_running_loop().create_server(make, "127.0.0.1", 0)
    address = server.sockets[0].getsockname()[:2]
    hello = encode_frame(management=encode_management(Configuration(UNITY, 0)))
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.create_connection(address)) for _ in range(count)]
        await until(lambda: busy.came == count)
        for each in sockets if configured else ():
            each.sendall(hello)
        await asyncio.sleep(0)
        yield sockets
    server.close()


async def test_a_neighbour_has_its_turn_among_them() -> None:
    """What somebody says while another's hundred questions are answered is heard before the last of them; these stay
    in their order, with what came between and behind them."""
    busy = Busy()
    async with two(busy) as (one, other):
        busy.on_first = lambda: other.sendall(said("stop"))
        one.sendall(
            b"".join(map(question, range(1, MANY // 2)))
            + said("between")
            + b"".join(map(question, range(MANY // 2, MANY)))
        )
        one.sendall(said("behind"))
        await until(lambda: (1, "behind") in busy.did)
        mine = [what for who, what in busy.did if who == 1]
        assert mine == [*range(1, MANY // 2), "between", *range(MANY // 2, MANY), "behind"]
        assert busy.did.index((2, "stop")) < MANY // 2


async def test_all_of_it_counts_when_the_connection_ends_meanwhile() -> None:
    """Who says much, then stops a robot, and is gone: all that it said comes before its end, as if it had been read
    in one go."""
    busy = Busy()
    async with two(busy) as (one, _):
        one.sendall(b"".join(map(question, range(1, MANY))) + said("stop"))
        with suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)
        await until(lambda: (1, "closed") in busy.did)
        assert [what for who, what in busy.did if who == 1] == [*range(1, MANY), "stop", "closed"]


async def test_who_says_goodbye_does_not_sleep_when_the_connection_ends_meanwhile() -> None:
    """A socket ends while a goodbye waits for its turn: the agent has left, and is not expected back."""
    busy = Busy()
    async with two(busy) as (one, _):
        connection = busy.connections[0]
        connection.expect_back(Kept(1 << 20, 100, Room(1 << 20)))
        busy.on_first = connection.abort
        goodbye = encode_frame(management=encode_management(GoOffline()))
        one.sendall(b"".join(map(question, range(1, MANY))) + goodbye + said("behind"))
        await until(lambda: busy.did[-1][1] in ("closed", "asleep") if busy.did else False)
        assert [what for who, what in busy.did if who == 1] == [*range(1, MANY), "closed"]


async def test_who_says_goodbye_does_not_sleep_when_the_connection_is_just_ending() -> None:
    """Likewise when the socket has ended and nobody has been told yet."""
    busy = Busy()
    async with two(busy) as (one, _):
        connection = busy.connections[0]
        connection.expect_back(Kept(1 << 20, 100, Room(1 << 20)))
        busy.on_first = connection.abort
        one.sendall(question(1) + encode_frame(management=encode_management(GoOffline())))
        await until(lambda: busy.did[-1][1] in ("closed", "asleep") if busy.did else False)
        assert busy.did == [(1, 1), (1, "closed")]


async def test_who_may_not_come_in_says_nothing_when_the_connection_ends_meanwhile() -> None:
    """A socket ends while a robot's configuration waits for its turn: if it is not let in, nothing of what came
    before its configuration or behind it goes out."""
    busy = Busy()
    busy.robots_may_come = False
    async with two(busy, configured=False):
        connection = busy.connections[0]
        configured = encode_frame(management=encode_management(Configuration(ROS, 0)))
        data = said("held") + configured + said("behind")
        space, now = connection.peer.space(), time.monotonic()
        space[: len(data)] = data
        del space
        busy.on_first = connection.abort
        costly = [AskedOnline(number) for number in range(1, MANY)]
        connection.take(chain(costly, connection.peer.advance(len(data), now) or ()), now)
        await until(lambda: (1, "closed") in busy.did)
        assert [what for who, what in busy.did if who == 1] == [*range(1, MANY), "closed"]


async def test_who_is_given_up_sleeps_behind_what_it_said() -> None:
    """A headset does not read, and its time is over while what it said waits: all of that comes before its sleep,
    in which robots have stopped."""
    busy = Busy()
    async with two(busy, write_timeout_s=0.0) as (one, _):
        connection = busy.connections[0]
        connection.expect_back(Kept(1 << 20, 100, Room(1 << 20)))
        busy.on_first = connection.pause_writing  # as its transport does when it is full
        one.sendall(b"".join(map(question, range(1, MANY))) + said("drive"))
        await until(lambda: {(1, "asleep"), (1, "drive")} <= set(busy.did))
        assert [what for who, what in busy.did if who == 1] == [*range(1, MANY), "drive", "asleep"]


async def test_a_frame_that_cannot_be_read_costs_no_other(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Of frames that came together one meets a fault of ours: it is counted, told once with where it was, and those
    around it count, also when they waited for the configuration."""
    busy = Busy()
    frame_of, send_of = TcpAgent._frame, TcpAgent._send

    def fails(name: str, read: Callable[..., None]) -> Callable[..., None]:
        def reads(self: TcpAgent, frame: Frames, events: list[Event]) -> None:
            if name.encode() in frame.data and self.state is State.ONLINE:
                raise ZeroDivisionError(name)
            read(self, frame, events)

        return reads

    monkeypatch.setattr(TcpAgent, "_frame", fails("early", frame_of))
    monkeypatch.setattr(TcpAgent, "_send", fails("late", send_of))
    hello = encode_frame(management=encode_management(Configuration(UNITY, 0)))
    async with two(busy, configured=False) as (one, _):
        one.sendall(said("before") + said("early") + said("between") + hello)
        one.sendall(question(1) + said("late") + question(2) + said("late") + said("behind"))
        await until(lambda: (1, "behind") in busy.did)
        assert [what for who, what in busy.did if who == 1] == ["before", "between", 1, 2, "behind"]
        assert busy.connections[0].all_drops() == {"failed": 3}
    (told,) = [record for record in caplog.records if record.exc_info]
    assert str(busy.connections[0]) in told.getMessage()


async def test_to_decrypt_is_work_for_who_sends() -> None:
    """What is small over TLS takes longer between the question for room and the data than behind it: as much less is
    read at once as behind costly frames."""
    busy = Busy()
    async with two(busy):
        connection = busy.connections[0]
        await until(lambda: connection.peer.state is State.ONLINE)
        room = connection.get_buffer(-1)
        before, data = len(room), said("a")
        until_s = time.monotonic() + 4 * TURN_S
        while time.monotonic() < until_s:
            pass
        room[: len(data)] = data
        connection.buffer_updated(len(data))
        assert busy.did == [(connection.agent_id, "a")]
        assert len(connection.get_buffer(-1)) <= before // 3


class Timed(Busy):
    """One that a clock stands beside, which its work alone moves on."""

    def __init__(self) -> None:
        super().__init__()
        self.clock_s = 100.0
        self.round = 0
        self.rounds: list[int] = []
        """In which round of the loop each question was answered."""

    def handle(self, connection: Connection, event: Event) -> None:
        super().handle(connection, event)
        if isinstance(event, AskedOnline):
            self.clock_s += COSTS_S
            self.rounds.append(self.round)


def _use_up(busy: Timed, memory: Memory, connection: Connection) -> None:
    """What a round of the loop has for its address, which takes much."""
    while not memory.rounds.are_over(connection.host):
        busy.clock_s += TURN_S
        memory.rounds.spend(connection.host, Share(), TURN_S)


async def test_many_of_one_address_wait_for_each_other_and_not_everybody_for_all_of_them() -> None:
    """Each asks one thing, which takes a part of a turn: what is read from all of them in one round of the loop is
    not answered in that round."""
    busy = Timed()
    memory = Memory(64 << 20, 32 << 20)
    memory.rounds = Rounds(lambda: busy.clock_s)

    def passes() -> None:
        busy.round += 1
        ticking[0] = loop.call_soon(passes)

    loop = asyncio.get_running_loop()
    ticking = [loop.call_soon(passes)]
    async with many(busy, memory, 20) as sockets:
        for number in range(1, 4):
            for each in sockets:
                each.sendall(question(number))
            await until(lambda wanted=20 * number: len(busy.rounds) == wanted)  # type: ignore[misc]
    ticking[0].cancel()
    in_round = Counter(busy.rounds[20:])  # the first of them show that the address takes much
    assert max(in_round.values()) <= 2 * TURN_S / COSTS_S + 2


async def test_a_stop_from_the_address_of_many_that_take_much_comes_before_what_they_say() -> None:
    """Behind one address there may be many houses and one proxy: who presses is handled within a few turns, and not
    when each of twenty that flood has had one."""
    busy = Timed()
    memory = Memory(64 << 20, 32 << 20)
    memory.rounds = Rounds(lambda: busy.clock_s)
    async with many(busy, memory, 21) as (presser, *floods):
        for each in floods:
            each.sendall(b"".join(question(number) for number in range(2, MANY)))
        for part in range(1, 4):
            await until(lambda wanted=part * 20 * MANY // 4: len(busy.rounds) >= wanted)  # type: ignore[misc]
            before = len(busy.did)
            presser.sendall(said(f"stop {part}"))
            await until(lambda said=(1, f"stop {part}"): said in busy.did)  # type: ignore[misc]
            assert busy.did.index((1, f"stop {part}")) - before <= 8 * TURN_S / COSTS_S


async def test_what_is_encrypted_for_one_of_many_waits_for_its_turn() -> None:
    """Topics and answers do, in their order; what goes to a robot program does not."""
    busy = Timed()
    memory = Memory(64 << 20, 32 << 20)
    memory.rounds = Rounds(lambda: busy.clock_s)
    async with many(busy, memory, 2):
        headset, robot = busy.connections
        robot.peer.agent_type = ROS
        headset._writer.encrypts = robot._writer.encrypts = True  # as it is over TLS
        _use_up(busy, memory, headset)
        sent = headset.sent_bytes, robot.sent_bytes
        for each in (headset, robot):
            assert each.gather_calls([b"one"])
            each.flush()
        assert (headset.sent_bytes, robot.sent_bytes) == (sent[0], sent[1] + 3)
        assert not headset.gather_calls([b"two"])
        headset.flush()
        assert headset.sent_bytes == sent[0]
        await until(lambda: headset.sent_bytes == sent[0] + 6)


async def test_who_was_read_from_in_a_round_that_is_over_waits_for_his_turn() -> None:
    """Also with what is no whole frame yet: to read and to take apart costs as well."""
    busy = Timed()
    memory = Memory(64 << 20, 32 << 20)
    memory.rounds = Rounds(lambda: busy.clock_s)
    async with many(busy, memory, 2) as (one, _):
        one.sendall(question(1))
        await until(lambda: (1, 1) in busy.did)
        connection = busy.connections[0]
        _use_up(busy, memory, connection)
        asked = question(2)
        while asked:
            room = connection.get_buffer(-1)
            assert len(room) <= LATE_READ_BYTES
            piece, asked = asked[: len(room)], asked[len(room) :]
            room[: len(piece)] = piece
            connection.buffer_updated(len(piece))
            assert connection._pauses == 1
            assert (1, 2) not in busy.did
            await until(lambda: not connection._pauses)
            _use_up(busy, memory, connection)
        await until(lambda: (1, 2) in busy.did)


async def test_a_stop_is_read_whole_of_who_has_had_little_himself() -> None:
    """Whatever others of his address take; of these next to nothing is read."""
    busy = Timed()
    memory = Memory(64 << 20, 32 << 20)
    memory.rounds = Rounds(lambda: busy.clock_s)
    async with many(busy, memory, 1):
        connection = busy.connections[0]
        await until(lambda: connection.peer.state is State.ONLINE and not connection._pauses)
        _use_up(busy, memory, connection)
        assert len(connection.get_buffer(-1)) == LATE_READ_BYTES > len(said("stop"))
        connection._share.spend(LITTLE_HAD_S, busy.clock_s)
        assert len(connection.get_buffer(-1)) == OVER_READ_BYTES


async def test_more_is_read_at_once_of_what_costs_little_though_it_waits_for_its_turn(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Or who waits for each turn, since he or others send much, would be read from in small pieces for ever."""
    monkeypatch.setattr("bridge.gateway.connection.TURN_S", 10.0)  # a busy machine makes nothing costly
    busy = Timed()
    memory = Memory(64 << 20, 32 << 20)
    memory.rounds = Rounds(lambda: busy.clock_s)
    async with many(busy, memory, 2):
        connection = busy.connections[0]
        await until(lambda: connection.peer.state is State.ONLINE)
        connection._read_bytes = 2048
        for _ in range(3):
            at_once = connection._read_bytes
            data = said("x") * (at_once // len(said("x")))
            room = connection.get_buffer(-1)
            _use_up(busy, memory, connection)
            room[: len(data)] = data
            connection.handle(len(data), time.monotonic())
            assert connection._waits
            await until(lambda: not connection._waits and not connection._pauses)
            assert connection._read_bytes == 2 * at_once


async def test_late_in_a_long_round_little_is_read_of_anybody() -> None:
    """Of many that begin in the same moment each has his turn before him; what is left comes in the next round."""
    busy = Timed()
    memory = Memory(64 << 20, 32 << 20)
    memory.rounds = Rounds(lambda: busy.clock_s)
    async with many(busy, memory, 2):
        connection = busy.connections[0]
        await until(lambda: connection.peer.state is State.ONLINE)
        await asyncio.sleep(0)
        for number in range(3):
            busy.clock_s += TURN_S
            memory.rounds.spend(f"10.0.0.{number}", Share(), 0.9 * TURN_S)
        data = (said("x") * LATE_READ_BYTES)[:LATE_READ_BYTES]
        room = connection.get_buffer(-1)
        assert len(room) == LATE_READ_BYTES
        room[:] = data
        connection.buffer_updated(len(data))
        assert connection._pauses
        await until(lambda: not connection._pauses)
        assert not memory.rounds.long
