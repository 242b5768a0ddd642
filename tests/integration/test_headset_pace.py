"""What a headset sends to a robot through a gateway: not more than its share, and nothing that has waited."""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import AsyncIterator, Hashable
from contextlib import asynccontextmanager

import pytest

import macs_zenoh
from bridge.gateway import Gateway, latest, questions
from bridge.gateway.connection import Connection
from bridge.headset.client import Headset
from macs_zenoh.agent import Agent
from macs_zenoh.protocol.halts import HALTS_PER_S
from macs_zenoh.protocol.messages import Configuration, Metadata, Welcome, encode_management
from macs_zenoh.protocol.rate_limit import Flow, Pace, Passing
from macs_zenoh.protocol.reading import Message
from macs_zenoh.protocol.wire import encode_frame, encode_message
from tests.support.given import Connect, StartGateway
from tests.support.local import patient
from tests.support.sockets import Socket, socket
from tests.support.waiting import until

MOVE, STOP = ("nd__cmd_vel", "geometry_msgs/Twist"), ("nd__emergency_stop", "std_msgs/Bool")


@pytest.fixture
async def robot(router: str) -> AsyncIterator[Agent]:
    async with macs_zenoh.join("ros", id=7, settings=patient(router)) as robot:
        yield robot


def frame(number: int, node: tuple[str, str] = MOVE, node_type: int = 2) -> bytes:
    metadata = Metadata(node_type=node_type, node_name=node[0], data_exchange_type=node[1])
    return encode_frame(1, (7,), message=encode_message(metadata.encode(), b"%d" % number))


def moving(data: bytes) -> bytes:
    metadata = Metadata(node_type=2, node_name=MOVE[0], data_exchange_type=MOVE[1])
    return encode_frame(1, (7,), message=encode_message(metadata.encode(), data))


FAST, STILL = (b"\0\1\0\0" + struct.pack("<6d", speed, 0, 0, 0, 0, -0.0) for speed in (0.5, 0.0))


def fill(connection: Connection, data: bytes) -> int:
    """Put data where a connection reads, in one piece; how much it was."""
    connection.get_buffer(-1)[: len(data)] = data
    return len(data)


def velocities(robot: Agent) -> list[bytes]:
    """What has come so far of `moving`."""
    messages: list[Message] = list(robot._inbox)
    return [bytes(message.data) for message in messages if bytes(message.data) in (FAST, STILL)]


def taken(robot: Agent, node: tuple[str, str] = MOVE) -> list[int]:
    """What has come so far of one kind, and is forgotten."""
    messages: list[Message] = list(robot._inbox)
    return [
        int(message.data)
        for message in messages
        if message.metadata.node_name == node[0] and bytes(message.data) not in (FAST, STILL)
    ]


async def ready(gateway: Gateway, headset: Socket) -> None:
    headset.configure()
    await until(lambda: (1, 7) in gateway.directory and (2, headset.id) in gateway.directory)


async def drive_and_pause(headset: Socket) -> None:
    """Ten commands at 20 Hz, numbered; then nothing comes for more than a second."""
    for number in range(10):
        headset.writer.write(frame(number))
        await asyncio.sleep(0.05)
    await asyncio.sleep(1.1)


def drops(gateway: Gateway, headset: Socket) -> dict[str, int]:
    return dict(gateway.agents.find(2, headset.id).all_drops())


class Paced(Pace):
    """By a clock of the test's."""

    def __init__(self, clock: list[float]) -> None:
        super().__init__(0, 0, 0.0)
        self._clock, self.seen = clock, 0

    def command(self, kind: Hashable, count: int, now: float, size: int = 0) -> Passing:
        self.seen += 1
        return super().command(kind, count, self._clock[0])


@pytest.fixture
def together(monkeypatch: pytest.MonkeyPatch) -> None:
    """What comes at once does for the gateway, though a busy machine takes time between two of it."""
    monkeypatch.setattr(latest, "TOGETHER_S", 0.5)


async def test_a_headset_whose_network_stood_still_does_not_make_up_for_it(
    start_gateway: StartGateway, robot: Agent, together: None
) -> None:
    """It drove at 20 Hz, nothing came for more than a second, then all at once: the newest command of each topic goes
    on, and the stop that was among them."""
    gateway, clock = await start_gateway(), [0.0]
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        paced = gateway.agents.find(2, headset.id).pace = Paced(clock)
        for number in range(10):
            clock[0] += 0.05
            headset.writer.write(frame(number))
            await until(lambda number=number: paced.seen > number)
        clock[0] += 1.1
        arm = ("nd__arm", MOVE[1])
        waited = [frame(100 + number) + frame(200 + number, arm) for number in range(20)]
        headset.writer.write(b"".join([*waited[:10], frame(1, STOP), *waited[10:]]))
        await until(lambda: taken(robot)[-1:] == [119] and taken(robot, arm)[-1:] == [219] and taken(robot, STOP))
        assert taken(robot) == [*range(10), 119]
        assert taken(robot, arm) == [219]
        clock[0] += 0.2
        headset.writer.write(frame(1000))
        await until(lambda: taken(robot)[-1] == 1000)
        assert drops(gateway, headset)["too_old"] == 38


async def test_what_waited_behind_several_topics_or_a_bool_is_not_made_up_for(
    start_gateway: StartGateway, robot: Agent, together: None
) -> None:
    """Two topics in each cycle, then a stall; what waited comes in pieces, a message of std_msgs/Bool first. The
    newest of each goes on, once nothing newer has come for a moment."""
    gateway, clock = await start_gateway(), [0.0]
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        paced = gateway.agents.find(2, headset.id).pace = Paced(clock)
        arm = ("nd__arm", MOVE[1])
        for number in range(10):
            clock[0] += 0.05
            headset.writer.write(frame(number) + frame(number, arm))
            await until(lambda number=number: paced.seen == 2 * number + 2)
        clock[0] += 1.1
        headset.writer.write(frame(1, ("nd__light", "std_msgs/Bool")))
        for piece in range(10):
            seen = paced.seen
            headset.writer.write(
                b"".join(frame(100 + piece * 2 + n) + frame(500 + piece * 2 + n, arm) for n in range(2))
            )
            await until(lambda seen=seen: paced.seen >= seen + 4)
            clock[0] += 0.005
        await until(lambda: taken(robot)[-1:] == [119] and taken(robot, arm)[-1:] == [519])
        assert taken(robot)[10:] == [119]
        assert taken(robot, arm)[10:] == [519]
        assert drops(gateway, headset) == {"too_old": 2 * 19}


class OnePaused(Pace):
    """Of a connection whose first command has waited, and the second not: they are far apart in one long read."""

    def command(self, kind: Hashable, count: int, now: float, size: int = 0) -> Passing:
        first, self._flows[kind] = kind not in self._flows, Flow()
        return Passing.WAITED if first else Passing.NOW


async def test_a_newer_command_is_not_followed_by_one_that_waited(start_gateway: StartGateway, robot: Agent) -> None:
    """What waits for a newer one goes on before one that has not waited, never behind it."""
    gateway = await start_gateway()
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        gateway.agents.find(2, headset.id).pace = OnePaused(1000, 1000, 0.0)
        headset.writer.write(frame(1) + frame(3, ("nd__arm", MOVE[1])) + frame(2) + frame(4))
        await until(lambda: taken(robot)[-1:] == [4] and taken(robot, ("nd__arm", MOVE[1])) == [3])
        await asyncio.sleep(0.1)
        assert taken(robot) == [1, 2, 4]
        assert drops(gateway, headset) == {}


async def test_who_pauses_and_drives_on_loses_nothing(start_gateway: StartGateway, robot: Agent) -> None:
    """Nothing waited in the network: the first command after the pause is held for a moment, and not dropped."""
    gateway = await start_gateway()
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        connection = gateway.agents.find(2, headset.id)
        now = [0.0]
        connection.pace = Paced(now)
        for number in range(40):
            now[0] += 0.05 if number != 20 else 3.0
            headset.writer.write(frame(number))
            await until(lambda number=number: connection.pace.seen == number + 1)
        await until(lambda: len(taken(robot)) == 40)
        assert taken(robot) == list(range(40))
        assert drops(gateway, headset) == {}


async def test_the_last_command_goes_on_though_its_sender_leaves(start_gateway: StartGateway, robot: Agent) -> None:
    """After a pause somebody sends one command more, the zero, and is gone: that is the one that counts."""
    gateway = await start_gateway()
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        await drive_and_pause(headset)
        headset.writer.write(frame(99))
        await headset.writer.drain()
        headset.writer.close()
    await until(lambda: taken(robot)[-1:] == [99])


async def test_a_burst_of_commands_is_passed_on(start_gateway: StartGateway, robot: Agent) -> None:
    """A program that does not drive at a pace may say many things at once, now and then, and in order."""
    gateway = await start_gateway()
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        for begin in (0, 100):
            headset.writer.write(b"".join(frame(number) for number in range(begin, begin + 100)))
            await until(lambda begin=begin: len(taken(robot)) == begin + 100)
            await asyncio.sleep(1.1)
        assert taken(robot) == list(range(200))


@pytest.mark.parametrize("node_type", [2, 3], ids=["commands", "requests"])
async def test_a_flood_is_held_to_its_share_and_a_stop_is_not(
    start_gateway: StartGateway, connect: Connect, robot: Agent, node_type: int
) -> None:
    """Of 20 000 messages to a robot at once a second's worth goes on, the rest is counted; stops of the flooder and
    commands of another headset all do."""
    gateway = await start_gateway(max_commands_per_s=300, max_requests_per_s=300)
    other: Headset = await connect(gateway)
    commands = await other.advertise("/arm", MOVE[1], agents=[7])
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        flood = b"".join(frame(number, node_type=node_type) for number in range(10_000))
        headset.writer.write(flood + frame(1, STOP) + flood)
        for number in range(10):
            await commands.publish(b"%d" % number)
        await until(lambda: taken(robot, STOP) == [1] and len(taken(robot, ("nd__arm", ""))) == 10)
        await until(lambda: drops(gateway, headset).get("flooded", 0) > 10_000)
        assert len(taken(robot)) < 5000


@pytest.mark.parametrize("node", [MOVE, STOP], ids=["commands", "what is no stop"])
async def test_large_commands_count_as_many(start_gateway: StartGateway, robot: Agent, node: tuple[str, str]) -> None:
    """Of forty of 1 MiB a few go on, also where they are said to be an emergency stop; the rest is counted."""
    gateway = await start_gateway(max_commands_per_s=100)
    metadata = Metadata(node_type=2, node_name=node[0], data_exchange_type=node[1])
    large = encode_frame(1, (7,), message=encode_message(metadata.encode(), bytes(1 << 20)))
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        headset.writer.write(large * 40)
        lost = gateway.mesh.drops
        await until(lambda: len(robot._inbox) + drops(gateway, headset).get("flooded", 0) + lost["backlog"] == 40)
        assert 0 < len(robot._inbox) <= 20, "two at once, and two more each second"


class Answering:
    """A headset that speaks as existing programs do, through a connection that can stand still: what it says waits
    there, an answer to its gateway behind the commands that it has said before."""

    SAYS_S, CARRIES_S = 0.02, 0.015
    """It says a command so often, and its connection carries a frame so often: what has waited takes three times as
    long as it waited."""

    def __init__(self, link: Socket, connection: Connection) -> None:
        self.link = link
        self.connection = connection
        self.moves = asyncio.Event()
        self.moves.set()
        self.said = 0
        self._says = asyncio.Event()
        self._says.set()
        self._waiting: asyncio.Queue[bytes] = asyncio.Queue()
        self._tasks = [asyncio.create_task(job) for job in (self._say(), self._carry(), self._answer())]

    async def _say(self) -> None:
        while True:
            await self._says.wait()
            self._waiting.put_nowait(frame(self.said))
            self.said += 1
            await asyncio.sleep(self.SAYS_S)

    async def _carry(self) -> None:
        while True:
            said = await self._waiting.get()
            await self.moves.wait()
            self.link.writer.write(said)
            await asyncio.sleep(self.CARRIES_S)

    async def _answer(self) -> None:
        while True:
            metadata, _ = await self.link.message()
            await self.moves.wait()
            if metadata.message_manager == Welcome.manager:
                answer = Configuration(agent_type=2, agent_id=self.link.id, request_id=metadata.request_id)
                self._waiting.put_nowait(encode_frame(management=encode_management(answer)))

    def pause(self) -> None:
        """Nobody drives."""
        self._says.clear()

    def let_go(self) -> None:
        """Nobody drives, and the headset says so once."""
        self.pause()
        self._waiting.put_nowait(moving(STILL))

    def drive(self) -> None:
        """Somebody does again."""
        self._says.set()

    @property
    def drops(self) -> dict[str, int]:
        """What its gateway has dropped of what it said."""
        return dict(self.connection.all_drops())

    def close(self) -> None:
        for task in self._tasks:
            task.cancel()


@asynccontextmanager
async def answering(gateway: Gateway) -> AsyncIterator[Answering]:
    """Such a headset, of which its gateway knows by now how soon it answers."""
    async with socket(gateway) as link:
        await ready(gateway, link)
        headset = Answering(link, gateway.agents.find(2, link.id))
        try:
            await until(lambda: headset.connection.pace.recency.is_quick)
            yield headset
        finally:
            headset.close()


async def test_what_waited_is_not_carried_out_however_slowly_it_comes(
    start_gateway: StartGateway, robot: Agent
) -> None:
    """A connection stands still for two seconds and then carries little more than is said: for seconds what comes is
    from then, and nothing of it is carried out. What is said later is, also a single command after a pause."""
    async with answering(await start_gateway()) as headset:
        headset.moves.clear()
        await until(lambda: taken(robot) and taken(robot)[-1] <= headset.said - 100)
        behind, before, since = headset.said, len(taken(robot)), time.monotonic()
        headset.moves.set()
        await until(lambda: taken(robot)[-1] >= behind)
        assert taken(robot)[before] >= behind, taken(robot)[before - 3 : before + 3]
        assert headset.drops["too_old"] >= 90, f"after {time.monotonic() - since} s"
        headset.pause()
        await until(lambda: taken(robot)[-1] == headset.said - 1)
        await asyncio.sleep(1.5)
        await until(lambda: headset.connection.pace.recency.age_at_most(time.monotonic()) < 0.3)
        headset.link.writer.write(frame(1_000_000))
        await until(lambda: taken(robot)[-1] == 1_000_000)


async def test_after_a_long_pause_a_driver_is_asked_with_the_first_command(
    start_gateway: StartGateway, robot: Agent, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who has not driven for long is asked no more; when he drives on, no more is lost than it takes to ask: the
    second command comes behind the answer."""
    async with answering(await start_gateway()) as headset:
        headset.pause()
        monkeypatch.setattr(questions, "ASKED_FOR_S", 0.5)
        await until(lambda: headset.connection.pace.recency.age_at_most(time.monotonic()) > 2.0)
        monkeypatch.undo()
        before, old = len(taken(robot)), headset.drops.get("too_old", 0)
        headset.link.writer.write(frame(1_000_000))
        await until(lambda: headset.drops.get("too_old") == old + 1)
        await until(lambda: not headset.connection.pace.in_doubt)
        headset.link.writer.write(frame(1_000_001))
        await until(lambda: taken(robot)[-1] == 1_000_001)
        assert len(taken(robot)) == before + 1


async def test_who_lets_go_while_his_network_stands_still_stops(start_gateway: StartGateway, robot: Agent) -> None:
    """What he said before is too old, and the zero is as well, but nobody says it again: it goes on, and nothing that
    was said before it does."""
    async with answering(await start_gateway()) as headset:
        headset.moves.clear()
        await until(lambda: taken(robot) and taken(robot)[-1] <= headset.said - 100)
        headset.let_go()
        said = headset.said
        headset.moves.set()
        await until(lambda: velocities(robot) == [STILL])
        assert taken(robot)[-1] < said - 90
        await until(lambda: not headset.connection.pace.in_doubt)
        headset.drive()
        await until(lambda: taken(robot)[-1] > said)
        assert not [number for number in taken(robot) if said - 90 <= number < said]
        assert headset.drops["too_old"] >= 90


class Said(Pace):
    """Of a connection about whose commands it is said this, one after the other; of all later ones the last."""

    def __init__(self, *passings: Passing) -> None:
        super().__init__(0, 0, 0.0)
        self._passings = [*passings]

    def command(self, kind: Hashable, count: int, now: float, size: int = 0) -> Passing:
        return self._passings.pop(0) if len(self._passings) > 1 else self._passings[0]


async def test_of_what_is_too_old_the_last_zero_goes_on(start_gateway: StartGateway, robot: Agent) -> None:
    """Also out of the middle of what came at once."""
    gateway = await start_gateway()
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        connection = gateway.agents.find(2, headset.id)
        connection.pace = Said(Passing.TOO_OLD)
        connection.buffer_updated(fill(connection, moving(FAST) * 3 + moving(STILL) + moving(FAST) * 2))
        await until(lambda: velocities(robot) == [STILL])
        assert drops(gateway, headset) == {"too_old": 5}


async def test_of_what_is_too_much_the_last_goes_on_if_it_is_zero(start_gateway: StartGateway, robot: Agent) -> None:
    """Or who sends what waited all at once would never be heard to stop."""
    gateway = await start_gateway()
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        connection = gateway.agents.find(2, headset.id)
        connection.pace = Said(Passing.FLOODED)
        connection.buffer_updated(fill(connection, moving(FAST) * 3 + moving(STILL)))
        await until(lambda: velocities(robot) == [STILL])
        assert drops(gateway, headset) == {"flooded": 3}


@pytest.mark.parametrize("passing", [Passing.TOO_OLD, Passing.FLOODED])
async def test_a_zero_is_not_followed_by_what_waited_before_it(
    start_gateway: StartGateway, robot: Agent, passing: Passing
) -> None:
    """Motion that waits for something newer has it."""
    gateway = await start_gateway()
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        gateway.agents.find(2, headset.id).pace = Said(Passing.WAITED, passing)
        headset.writer.write(moving(FAST) + frame(1, STOP) + moving(STILL))
        await until(lambda: velocities(robot)[-1:] == [STILL])
        await until(lambda: drops(gateway, headset) == {"too_old": 1} or len(velocities(robot)) > 1)
        assert velocities(robot) == [STILL]


async def test_zeros_are_a_flood_as_well(start_gateway: StartGateway, robot: Agent) -> None:
    """Of a thousand that are too many a few go on."""
    gateway = await start_gateway(max_commands_per_s=1)
    async with socket(gateway) as headset:
        await ready(gateway, headset)
        began = time.monotonic()
        for _ in range(200):
            headset.writer.write(moving(FAST) + moving(STILL) + frame(0, ("nd__arm", MOVE[1])))
        headset.writer.write(frame(1, STOP))
        await until(lambda: taken(robot, STOP) == [1])
        assert 1 <= velocities(robot).count(STILL) <= 2 + HALTS_PER_S * (1 + time.monotonic() - began)
