"""Who sends over TCP is slowed by what waits for its own frames in the gateway: nothing of them is lost there."""

from __future__ import annotations

import asyncio
import struct
import threading
import time
from collections.abc import AsyncIterator, Iterable, Iterator

import pytest

from benchmarks import sequence
from benchmarks.headset import TOPIC, Headset
from bridge.headset import frames
from bridge.headset.client import Headset as Looking
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh, Sample
from macs_zenoh.mesh.arrivals import Arrivals
from tests.support.local import PATIENT_MS
from tests.support.programs import Program, free_port
from tests.support.waiting import PATIENCE_S, until

DEPTH = frames.DEFAULT_BUFFER_SIZE
STANDS_STILL_AT = 5_000_000
KEY, ECHO = "macs/to/ros/7/from/unity/256", "macs/to/ros/8/from/unity/256"
SETTINGS = f"""[gateway]
robots = "any"
max_commands_per_s = 0
max_requests_per_s = 0
[mesh]
block_limit_ms = {PATIENT_MS}
"""
"""A program that gets no time for half a second is a busy machine here, not one that is gone."""


@pytest.fixture
async def two_ports(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[tuple[int, int]]:
    """The ports of two gateways on one router."""
    endpoint, near, far = f"tcp/127.0.0.1:{free_port()}", free_port(), free_port()
    settings = tmp_path_factory.mktemp("gateways") / "settings.toml"
    settings.write_text(SETTINGS)
    options = ("-e", endpoint, "--settings", str(settings))
    async with (
        Program("router", "-l", endpoint, "--settings", str(settings)),
        Program("gateway", "--port", str(near), *options) as first,
        Program("gateway", "--port", str(far), *options) as second,
    ):
        yield near, far
        print(*first.log, *second.log, sep="\n")  # what was lost, and where, beside a test that fails


@pytest.fixture
async def port(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[int]:
    """The port of a gateway that is a program of its own."""
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    settings = tmp_path_factory.mktemp("gateway") / "settings.toml"
    settings.write_text(SETTINGS)
    options = ("--port", str(port), "-e", endpoint, "--settings", str(settings))
    router = Program("router", "-l", endpoint, "--settings", str(settings))
    async with router, Program("gateway", *options):
        yield port


def pieces(frames_: Iterator[bytes]) -> bytes:
    """Frames as one piece to be sent unpaced."""
    return b"".join(frames_)


class Receiver(threading.Thread):
    """Reads at most so many bytes per second until it has all, or nothing comes for long; ``still_s`` is how long it
    stands still behind the first 5 MB."""

    def __init__(self, headset: Headset, wanted: int, bytes_per_s: float = 1e9, still_s: float = 0.0) -> None:
        super().__init__(daemon=True)
        self.numbers: list[tuple[int, int]] = []
        """(sender, number) of each message."""
        self._headset, self._wanted, self._bytes_per_s = headset, wanted, bytes_per_s
        self._still_s = still_s

    def run(self) -> None:
        sock = self._headset.socket
        sock.settimeout(PATIENCE_S)
        buffer, began, taken = bytearray(), time.monotonic(), 0
        try:
            while len(self.numbers) < self._wanted and (piece := sock.recv(64 << 10)):
                buffer += piece
                taken += len(piece)
                self._cut(buffer)
                if taken > STANDS_STILL_AT:
                    time.sleep(self._still_s)
                    self._still_s = 0.0
                time.sleep(max(0.0, began + taken / self._bytes_per_s - time.monotonic()))
        except TimeoutError:
            pass

    def _cut(self, buffer: bytearray) -> None:
        at = 0
        while len(buffer) - at >= 4:
            body_at = at + 4 + struct.unpack_from("<I", buffer, at)[0]
            if len(buffer) < body_at + 4:
                break
            end = body_at + 4 + struct.unpack_from("<I", buffer, body_at)[0]
            if len(buffer) < end:
                break
            if b'"requestId":1' in buffer[at:body_at] or b"nd__bench" in buffer[at:body_at]:
                sender = int(bytes(buffer[at:body_at]).split(b'"senderAgentId":')[1].split(b",")[0])
                self.numbers.append((sender, struct.unpack_from("<I", buffer, body_at + 8)[0]))
            at = end
        del buffer[:at]


def send(headset: Headset, data: bytes) -> threading.Thread:
    """Send in a thread, as fast as it is taken."""
    thread = threading.Thread(target=headset.socket.sendall, args=(data,), daemon=True)
    thread.start()
    return thread


async def known(ports: Iterable[int], headsets: Iterable[Headset]) -> None:
    """Wait until each gateway knows of all of them."""
    wanted = {headset.id for headset in headsets}
    for port in ports:
        async with await Looking.connect("127.0.0.1", port) as looking:
            while not wanted <= set((await looking.online(PATIENCE_S)).unity_agent_ids):
                await asyncio.sleep(0.02)


async def ended(*threads: threading.Thread) -> None:
    """Wait for threads."""
    for thread in threads:
        await asyncio.to_thread(thread.join, 2 * PATIENCE_S)
        assert not thread.is_alive()


async def test_many_senders_with_destinations_in_turn(port: int) -> None:
    """Eight headsets that send to two others in turn, unpaced: every message arrives, of each sender in order."""
    receivers = [Headset.join(port, 0) for _ in range(2)]
    senders = [Headset.join(port, 0) for _ in range(8)]
    ways = [{"ids": [receiver.id], "groups": []} for receiver in receivers]
    await known([port], [*receivers, *senders])
    count = 6000
    loads = [pieces(sequence.messages(sender.id, 64, count, ways)) for sender in senders]
    reading = [Receiver(receiver, count // 2 * len(senders)) for receiver in receivers]
    for thread in reading:
        thread.start()
    await ended(*map(send, senders, loads), *reading)
    for turn, thread in enumerate(reading):
        for sender in senders:
            assert [n for who, n in thread.numbers if who == sender.id] == list(range(turn, count, 2))


async def test_many_destinations_in_each_message(port: int) -> None:
    """Of small frames to ten agents each, by two lists in turn, one read is more than may wait: none is lost."""
    receivers = [Headset.join(port, 0) for _ in range(10)]
    senders = [Headset.join(port, 0) for _ in range(4)]
    ids = [receiver.id for receiver in receivers]
    ways = [{"ids": ids, "groups": []}, {"ids": ids[::-1], "groups": []}]
    await known([port], [*receivers, *senders])
    count = 3000
    loads = [pieces(sequence.messages(sender.id, 16, count, ways)) for sender in senders]
    reading = [Receiver(receiver, count * len(senders)) for receiver in receivers]
    for thread in reading:
        thread.start()
    await ended(*map(send, senders, loads), *reading)
    for thread in reading:
        for sender in senders:
            assert [n for who, n in thread.numbers if who == sender.id] == list(range(count))


async def test_a_receiver_that_is_slower_than_its_sender(port: int) -> None:
    """A headset that reads 15 MB a second gets all 40 MB of one that sends as fast as it can."""
    receiver, sender = Headset.join(port, 0), Headset.join(port, 0)
    await known([port], [receiver, sender])
    count = 40_000_000 // (64 << 10)
    load = pieces(sequence.messages(sender.id, 64 << 10, count, [{"ids": [receiver.id], "groups": []}]))
    reading = Receiver(receiver, count, 15e6)
    reading.start()
    await ended(send(sender, load), reading)
    assert [n for _, n in reading.numbers] == list(range(count))


@pytest.mark.parametrize("size", [pytest.param(1 << 10, marks=pytest.mark.soak), 64 << 10, 1 << 20])
async def test_a_slower_receiver_behind_another_gateway(two_ports: tuple[int, int], size: int) -> None:
    """The same between two gateways: the receiver's says that it is full, and the sender's reads less."""
    sender, receiver = Headset.join(two_ports[0], 0), Headset.join(two_ports[1], 0)
    await known(two_ports, [sender, receiver])
    count = 60_000_000 // size
    load = pieces(sequence.messages(sender.id, size, count, [{"ids": [receiver.id], "groups": []}]))
    reading = Receiver(receiver, count, 15e6)
    reading.start()
    await ended(send(sender, load), reading)
    assert [n for _, n in reading.numbers] == list(range(count))


async def test_a_receiver_elsewhere_that_stands_still_for_a_moment(two_ports: tuple[int, int]) -> None:
    """Half a second in which a slower receiver takes nothing, as Wi-Fi and busy machines have it, costs no message."""
    sender, receiver = Headset.join(two_ports[0], 0), Headset.join(two_ports[1], 0)
    await known(two_ports, [sender, receiver])
    count = 50
    load = pieces(sequence.messages(sender.id, 1 << 20, count, [{"ids": [receiver.id], "groups": []}]))
    reading = Receiver(receiver, count, 15e6, still_s=0.5)
    reading.start()
    await ended(send(sender, load), reading)
    assert [n for _, n in reading.numbers] == list(range(count))


async def test_slower_receivers_in_a_group_behind_another_gateway(two_ports: tuple[int, int]) -> None:
    """Of five in a group each gets everything, though they read at different rates, from two senders."""
    receivers = [Headset.join(two_ports[1], 7) for _ in range(5)]
    senders = [Headset.join(two_ports[0], 0) for _ in range(2)]
    await known(two_ports, [*receivers, *senders])
    count = 20_000_000 // (64 << 10)
    way = [{"ids": [], "groups": [7]}]
    loads = [pieces(sequence.messages(sender.id, 64 << 10, count, way)) for sender in senders]
    reading = [Receiver(receiver, 2 * count, 12e6 + 4e6 * i) for i, receiver in enumerate(receivers)]
    for thread in reading:
        thread.start()
    await ended(*map(send, senders, loads), *reading)
    for thread in reading:
        for sender in senders:
            assert [n for who, n in thread.numbers if who == sender.id] == list(range(count))


async def test_large_frames_to_many_slow_receivers_elsewhere(two_ports: tuple[int, int]) -> None:
    """However many receivers are full at once, a sender's frame comes to its end: four a second go on."""
    sender = Headset.join(two_ports[0], 0)
    receivers = [Headset.join(two_ports[1], 0) for _ in range(10)]
    await known(two_ports, [sender, *receivers])
    ids = [receiver.id for receiver in receivers]
    load = pieces(sequence.messages(sender.id, 3 << 20, 6, [{"ids": ids, "groups": []}]))
    reading = [Receiver(receiver, 6, 6e6) for receiver in receivers]
    for thread in reading:
        thread.start()
    await ended(send(sender, load), *reading)
    for thread in reading:
        assert [n for _, n in thread.numbers] == list(range(6))


async def test_a_receiver_elsewhere_that_has_stopped_stops_nobody(two_ports: tuple[int, int]) -> None:
    """Whose receiver behind another gateway reads nothing at all is soon read from as before."""
    sender, stalled = Headset.join(two_ports[0], 0), Headset.join(two_ports[1], 0)
    await known(two_ports, [sender, stalled])
    load = pieces(sequence.messages(sender.id, 64 << 10, 1500, [{"ids": [stalled.id], "groups": []}]))
    await ended(send(sender, load))  # of more than all that may wait anywhere


@pytest.mark.parametrize(("size", "count", "bytes_per_s"), [(1 << 10, 20_000, 6e6), (1 << 20, 100, 40e6)])
async def test_a_robot_program_that_streams_unpaced(port: int, size: int, count: int, bytes_per_s: float) -> None:
    """One headset that registered on a robot program gets every message of its topic, in order."""
    robot, receiver = Headset.join(port, 0, robot=True), Headset.join(port, 0)
    await registered(robot, [receiver])
    load = pieces(sequence.topic(robot.id, size, count, [receiver.id], TOPIC))
    reading = Receiver(receiver, count, bytes_per_s)
    reading.start()
    await ended(send(robot, load), reading)
    assert [n for _, n in reading.numbers] == list(range(count))


async def test_a_headset_that_does_not_read_slows_down_nobody(port: int) -> None:
    """Of two headsets on a robot program's topic one reads nothing, of 16 MB: the other gets every message. No more
    are on their way than wait for a slow reader in any case: the other is one while its thread has no time."""
    robot, receiver, stalled = Headset.join(port, 0, robot=True), Headset.join(port, 0), Headset.join(port, 0)
    await registered(robot, [receiver, stalled])
    count = 2000
    reading = Receiver(receiver, count)
    reading.start()
    load = sequence.topic(robot.id, 8192, count, [receiver.id, stalled.id], TOPIC)
    for sent, frame in enumerate(load):
        await until(lambda sent=sent: sent - len(reading.numbers) < DEPTH, PATIENCE_S)  # type: ignore[misc]
        await asyncio.to_thread(robot.socket.sendall, frame)
    await ended(reading)
    assert [n for _, n in reading.numbers] == list(range(count))


async def registered(robot: Headset, headsets: list[Headset]) -> None:
    """Wait until the robot was told of each registration on its topic."""
    for headset in headsets:
        headset.socket.sendall(frames.registration(headset.id, TOPIC, [robot.id], []))
    told = bytearray()
    robot.socket.settimeout(PATIENCE_S)
    while told.count(b"nd__bench") < len(headsets):
        told += await asyncio.to_thread(robot.socket.recv, 65536)


async def test_what_the_loop_puts_waits_for_itself(router: str) -> None:
    """Who makes room after each put on the loop loses nothing of any number, and keeps the order; a handler that puts
    and makes room, which is inside of it, does not wait for itself."""
    got: list[int] = []
    echoed: list[int] = []
    async with await Mesh.open(MeshSettings(connect=[router])) as mesh:

        def note(batch: Iterator[Sample]) -> None:
            for _, payload in batch:
                got.append(int(payload))
                mesh.put(ECHO, payload)
                mesh.make_room()

        mesh.subscribe(KEY, note)
        mesh.subscribe(ECHO, lambda batch: echoed.extend(int(payload) for _, payload in batch))
        count = 3 * Arrivals.LIMIT
        for number in range(count):
            mesh.put(KEY, b"%d" % number)
            mesh.make_room()
        await until(lambda: len(echoed) == count)
        assert got == echoed == list(range(count))
        assert not mesh.drops["loop_behind"]
