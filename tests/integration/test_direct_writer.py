"""A gateway writes topic data past its event loop: whole messages, in order, with asyncio's loop and with uvloop."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from pathlib import Path

import pytest
import uvloop

from bridge.gateway import Gateway
from bridge.gateway.connection import Connection
from bridge.gateway.memory import Memory
from bridge.headset import frames
from bridge.headset.frames import NodeSpec
from macs_zenoh import Agent, join
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.existing import CDR
from macs_zenoh.protocol.keyexpr import STREAM
from macs_zenoh.protocol.messages import AddNode, Metadata, NodeType, StreamData, encode_management
from macs_zenoh.protocol.outbox import Chunk, Outbox
from macs_zenoh.protocol.tcp_agent import TcpAgent
from macs_zenoh.protocol.wire import encode_frame, encode_message, split_message
from macs_zenoh.streams import Streams
from tests.support.given import StartGateway
from tests.support.local import patient
from tests.support.matching import matched
from tests.support.waiting import PATIENCE_S, until

pytestmark = pytest.mark.filterwarnings('ignore:Overriding the "event_loop_policy" fixture is deprecated')

TOPIC = NodeSpec(NodeType.SUBSCRIBER, "/image", "sensor_msgs/Image", 10_000)
IMAGE = TOPIC.name.encode()


@pytest.fixture(
    params=[pytest.param(asyncio.DefaultEventLoopPolicy, marks=pytest.mark.soak), uvloop.EventLoopPolicy],
    ids=["asyncio", "uvloop"],
)
def event_loop_policy(request: pytest.FixtureRequest) -> asyncio.AbstractEventLoopPolicy:
    """Both are used: uvloop wherever it is installed."""
    policy: asyncio.AbstractEventLoopPolicy = request.param()
    return policy


def number(data: bytes) -> int:
    """What numbered data begins with, behind the header of ROS data."""
    return int.from_bytes(data[4:8], "big")


def image(registrants: list[int], i: int, size: int) -> bytes:
    """A frame of a robot's topic with a numbered message."""
    metadata = Metadata(1, 7, 0, StreamData.manager, NodeType.SUBSCRIBER, TOPIC.name, "sensor_msgs/Image")
    data = CDR + i.to_bytes(4, "big") * (size // 4 - 1)
    management = encode_management(StreamData({"2": registrants}))
    return encode_frame(1, management=management, message=encode_message(metadata.encode(), data))


class Raw:
    """A headset on a bare socket that reads when it is told to."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port))
        self.socket.settimeout(PATIENCE_S)
        self._decoder = MessageDecoder()
        welcome = self.read()[0]
        self.id = int(welcome[1].split(b'"agentId":')[1].split(b"}")[0].split(b",")[0])
        self.socket.sendall(frames.configuration(self.id, 0, 1))
        self.socket.sendall(frames.registration(self.id, TOPIC, [7], []))

    def read(self) -> list[tuple[bytes, bytes]]:
        """Metadata and data of the messages that are whole after one read."""
        while not (messages := self._decoder.feed(self.socket.recv(1 << 16))):
            pass
        return [(metadata, bytes(data)) for metadata, data in map(split_message, messages)]


@pytest.fixture
def sent_now(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The threads that sent past the loop, one entry for each message."""
    threads: list[int] = []
    send = Connection.send_now

    def noted(connection: Connection, message: bytes) -> None:
        threads.append(threading.get_ident())
        send(connection, message)

    monkeypatch.setattr(Connection, "send_now", noted)
    return threads


@pytest.fixture
async def robot(router: str) -> AsyncIterator[Agent]:
    """Robot 7, which lets anybody register."""
    async with join("ros", id=7, settings=patient(router)) as agent:

        async def add(_call: object) -> bytes:
            return b""

        agent.serve("add_node", add)
        agent.serve("remove_node", add)
        yield agent


async def registered(gateway: Gateway, robot: Agent, ids: list[int]) -> None:
    """Wait until these are listening to the topic, and the robot knows."""
    await until(
        lambda: any({(2, i) for i in ids} <= stream.registrants for stream in gateway._delivery.streams.values())
    )
    await matched(robot.mesh, STREAM.of(type=1, id=robot.id, node=TOPIC.name))


async def test_topic_data_goes_past_the_loop(start_gateway: StartGateway, robot: Agent, sent_now: list[int]) -> None:
    """Messages with pauses between them reach every headset once, in order, from Zenoh's thread."""
    gateway = await start_gateway()
    headsets = [await asyncio.to_thread(Raw, gateway.port) for _ in range(3)]
    ids = [headset.id for headset in headsets]
    await registered(gateway, robot, ids)
    for i in range(60):
        Streams(robot).publish(TOPIC.name, image(ids, i, 400 + 4 * (i % 5)))
        await asyncio.sleep(0.005)
    for headset in headsets:
        got: list[int] = []
        while len(got) < 60:
            got += [number(data) for metadata, data in await asyncio.to_thread(headset.read) if IMAGE in metadata]
        assert got == list(range(60))
        headset.socket.close()
    assert len(sent_now) > 90
    assert threading.get_ident() not in sent_now


async def test_a_headset_that_reads_late_gets_whole_messages(
    start_gateway: StartGateway, robot: Agent, sent_now: list[int]
) -> None:
    """Messages that its socket takes in part, or not at all, come whole and in order once it reads."""
    gateway = await start_gateway()
    slow = await asyncio.to_thread(Raw, gateway.port)
    await registered(gateway, robot, [slow.id])
    count = 300
    for i in range(count):  # about 20 MB, more than the sockets hold
        Streams(robot).publish(TOPIC.name, image([slow.id], i, 70_000))
        await asyncio.sleep(0.002)
    await asyncio.sleep(0.2)
    assert len(sent_now) > 10
    got: list[bytes] = []
    while not got or number(got[-1]) < count - 1:
        got += [data for metadata, data in await asyncio.to_thread(slow.read) if IMAGE in metadata]
    assert all(data == CDR + data[4:8] * (len(data) // 4 - 1) for data in got)
    numbers = [number(data) for data in got]
    assert numbers == sorted(set(numbers))
    assert len(numbers) + sum(gateway.drops.values()) + sum(_drops(gateway).values()) == count
    slow.socket.close()


def _drops(gateway: Gateway) -> dict[str, int]:
    return dict(
        sum((connection.all_drops() for connection in gateway.agents.connections()), gateway.drops - gateway.drops)
    )


async def test_both_ways_into_one_socket_keep_messages_apart(
    start_gateway: StartGateway, robot: Agent, sent_now: list[int]
) -> None:
    """Answers from the loop and topic data from Zenoh's thread, to a headset whose socket is often full."""
    gateway = await start_gateway()
    headset = await asyncio.to_thread(Raw, gateway.port)
    await registered(gateway, robot, [headset.id])
    stop = threading.Event()

    def ask() -> None:
        asked = 0
        while not stop.is_set():
            asked += 1
            headset.socket.sendall(frames.online_request(headset.id, asked))
            time.sleep(0.001)

    seen: list[tuple[bytes, bytes]] = []

    def read() -> None:
        with suppress(TimeoutError):
            while not stop.is_set() or not seen or IMAGE not in seen[-1][0]:
                seen.extend(headset.read())
                time.sleep(0.002)  # slower than it comes

    asking, reading = asyncio.to_thread(ask), asyncio.to_thread(read)
    tasks = asyncio.gather(asking, reading)
    for i in range(400):
        Streams(robot).publish(TOPIC.name, image([headset.id], i, 60_000))
        await asyncio.sleep(0.004)
    stop.set()
    Streams(robot).publish(TOPIC.name, image([headset.id], 400, 60_000))
    await tasks
    topic = [data for metadata, data in seen if IMAGE in metadata]
    answers = [data for metadata, data in seen if IMAGE not in metadata]
    assert all(data == CDR + data[4:8] * (len(data) // 4 - 1) for data in topic)
    assert [number(data) for data in topic] == sorted({number(data) for data in topic})
    assert len(answers) > 20
    assert all(answer.startswith(b"{") for answer in answers)
    assert len(sent_now) > 20
    headset.socket.close()


async def test_descriptors_are_given_back(start_gateway: StartGateway, robot: Agent, sent_now: list[int]) -> None:
    """Headsets that come, get topic data and go, also in the middle of it, leave nothing open."""
    gateway = await start_gateway()
    before = len(list(Path("/proc/self/fd").iterdir()))
    for round_ in range(20):
        headset = await asyncio.to_thread(Raw, gateway.port)
        await registered(gateway, robot, [headset.id])
        for i in range(10):
            Streams(robot).publish(TOPIC.name, image([headset.id], i, 60_000))
            await asyncio.sleep(0.002)
            if i == round_ % 10:
                headset.socket.close()
        await until(lambda: not gateway.agents.connections())
    assert len(sent_now) > 40
    assert len(list(Path("/proc/self/fd").iterdir())) <= before + 1


async def test_who_leaves_sees_the_end_at_once(start_gateway: StartGateway, robot: Agent) -> None:
    """A gateway that stops closes the connection, second descriptor or not."""
    gateway = await start_gateway()
    headset = await asyncio.to_thread(Raw, gateway.port)
    await registered(gateway, robot, [headset.id])
    await gateway.close()

    def to_the_end() -> None:
        while headset.socket.recv(1 << 16):  # its socket has a limit of time
            pass

    await asyncio.to_thread(to_the_end)
    headset.socket.close()


# -- one connection --------------------------------------------------------------------------------------------------


class Nobody:
    """A gateway that does nothing."""

    def opened(self, connection: Connection) -> bool:
        connection.greet(TcpAgent(256, 1, time.monotonic()))
        node = AddNode(2, 256, NodeType.SUBSCRIBER, TOPIC.name, "/image", "sensor_msgs/Image", 100)
        connection.recipient.registered(node)
        connection.open_direct()
        return True

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *args: None


@pytest.fixture
async def connection() -> AsyncIterator[tuple[Connection, socket.socket]]:
    """A headset's connection, and the socket at its other end, of which the first message is read."""
    made: list[Connection] = []

    def make() -> Connection:
        made.append(Connection(Nobody(), memory=Memory(64 << 20, 32 << 20), outbox_bytes=64 << 20, write_timeout_s=30))  # type: ignore[arg-type]
        return made[0]

    server = await asyncio.get_running_loop().create_server(make, "127.0.0.1", 0)
    with socket.create_connection(server.sockets[0].getsockname()[:2]) as other:
        other.setblocking(False)
        await until(lambda: made and made[0].free)
        await asyncio.sleep(0.05)
        other.recv(1 << 16)
        yield made[0], other
        if not made[0]._transport.is_closing():
            made[0].abort()
    server.close()


async def drained(other: socket.socket, size: int) -> bytes:
    """So many bytes, while the loop goes on."""
    got = bytearray()
    while len(got) < size:
        with suppress(BlockingIOError):
            got += other.recv(1 << 20)
        await asyncio.sleep(0)
    return bytes(got)


async def test_the_rest_of_a_message_comes_before_anything_else(
    connection: tuple[Connection, socket.socket],
) -> None:
    """A message that the socket took in part is finished before what the loop has to send meanwhile."""
    ours, other = connection
    large, answer = b"L" * (32 << 20), b"a" * 1000
    ours.send_now(large)
    assert not ours.free
    ours.send_call(answer)
    assert await drained(other, len(large) + len(answer)) == large + answer


async def test_what_the_transport_holds_comes_first(connection: tuple[Connection, socket.socket]) -> None:
    """While anything waits in the transport, nothing goes past it, also when the socket has room again."""
    ours, other = connection
    sent = b""
    while not ours._transport.get_write_buffer_size():
        sent += b"c" * 100_000
        ours.send_call(b"c" * 100_000)
        await asyncio.sleep(0)
    got = other.recv(1 << 20)  # room, of which the transport does not know yet
    ours.send_now(b"topic")
    assert got + await drained(other, len(sent) + 5 - len(got)) == sent + b"topic"


async def test_a_connection_that_is_closed_has_its_messages_finished(
    connection: tuple[Connection, socket.socket],
) -> None:
    """Closing waits for the rest of a message that has begun."""
    ours, other = connection
    large = b"L" * (32 << 20)
    ours.send_now(large)
    ours.finish("the gateway stops")
    assert await drained(other, len(large)) == large


async def test_messages_past_the_loop_keep_their_order(connection: tuple[Connection, socket.socket]) -> None:
    """Whatever the socket takes of each, all, a part or nothing, and whenever it is read."""
    ours, other = connection
    sent, got, size = 0, bytearray(), 512
    for _ in range(4):
        more = 20  # that come after the socket was full; the loop has not run since
        while more:
            more -= not ours.free
            ours.send_now(sent.to_bytes(4, "big") * (size // 4))
            sent += 1
            if more < 10:
                got += other.recv(20_000)
        got += await drained(other, sent * size - len(got))
        await until(lambda: ours.free)
    assert bytes(got) == b"".join(i.to_bytes(4, "big") * (size // 4) for i in range(sent))


async def test_nothing_passes_what_waits_in_the_outbox(
    connection: tuple[Connection, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A headset reads again: while older messages go from its outbox to the socket, new ones do not go past them."""
    ours, other = connection
    take = Outbox.take

    def slowly(outbox: Outbox, size: int) -> list[Chunk]:
        time.sleep(0.02)
        taken = take(outbox, size)
        time.sleep(0.02)
        return taken

    monkeypatch.setattr(Outbox, "take", slowly)
    sent = []
    while len(ours._outbox) < 8:
        sent.append(len(sent).to_bytes(4, "big") * 25_000)
        ours.gather_stream(TOPIC.name, [sent[-1]])
        ours.flush()
        await asyncio.sleep(0)
    newer = len(sent).to_bytes(4, "big") * 100
    went = threading.Event()

    def passes() -> None:
        while not went.is_set():
            if ours.free:
                ours.send_now(newer)
                went.set()

    passing = asyncio.create_task(asyncio.to_thread(passes))
    got = await drained(other, sum(map(len, sent)) + len(newer))
    await passing
    assert got == b"".join(sent) + newer
