"""What is handled in Zenoh's threads, past the event loop: in order, and once."""

from __future__ import annotations

import asyncio
import random
import threading
import time
from collections.abc import AsyncIterator, Callable, Hashable, Iterator
from contextlib import suppress

import pytest

from macs_zenoh.config import MeshSettings
from macs_zenoh.errors import NotServed
from macs_zenoh.mesh import Mesh, Payload, Sample, Traffic
from macs_zenoh.mesh.arrivals import Arrivals
from macs_zenoh.protocol.keyexpr import CALL
from tests.support.matching import matched
from tests.support.waiting import PATIENCE_S, until

KEY, OTHER_KEY = "macs/to/ros/7/from/unity/256", "macs/to/ros/7/from/unity/257"
PAUSE_S = 3 * Arrivals.CALM_S


def number(payload: Payload) -> int:
    """What a numbered payload begins with."""
    return int.from_bytes(payload[:4], "big")


class Receiver:
    """Notes the numbers of samples in the order in which they are handled, and where."""

    def __init__(self) -> None:
        self.numbers: list[int] = []
        self.at_once = 0
        self.batches: list[int] = []
        self.threads: set[int] = set()
        self.takes = lambda number: True

    def batch(self, batch: Iterator[Sample]) -> None:
        """On the loop."""
        come = [number(payload) for _, payload in batch]
        self.batches.append(len(come))
        self.numbers += come

    def one(self, _key: str, payload: Payload) -> bool:
        """At once."""
        self.threads.add(threading.get_ident())
        if not self.takes(number(payload)):
            return False
        self.at_once += 1
        self.numbers.append(number(payload))
        return True


@pytest.fixture
async def sender(router: str) -> AsyncIterator[Mesh]:
    """Somebody else on the mesh."""
    async with await Mesh.open(MeshSettings(connect=[router])) as mesh:
        yield mesh


@pytest.fixture
async def mesh(router: str) -> AsyncIterator[Mesh]:
    """Who receives."""
    async with await Mesh.open(MeshSettings(connect=[router])) as mesh:
        yield mesh


async def listening(mesh: Mesh, sender: Mesh, receiver: Receiver) -> None:
    """Subscribe, and wait until what the sender puts arrives."""
    mesh.subscribe(KEY, receiver.batch, at_once=receiver.one)
    await matched(sender, KEY)


async def test_a_single_sample_is_taken_in_zenohs_thread(mesh: Mesh, sender: Mesh) -> None:
    """Samples with pauses between them never come to the loop."""
    receiver = Receiver()
    await listening(mesh, sender, receiver)
    for i in range(50):
        sender.put(KEY, i.to_bytes(4, "big"), Traffic.COMMAND)
        await until(lambda i=i: len(receiver.numbers) == i + 1)
        await asyncio.sleep(PAUSE_S)
    assert receiver.numbers == list(range(50))
    assert receiver.at_once == 50
    assert threading.get_ident() not in receiver.threads


async def test_the_order_is_kept_between_both_ways(mesh: Mesh, sender: Mesh) -> None:
    """Single samples, bursts, and samples that are not taken at once: all come once, in their order."""
    receiver = Receiver()
    dice = random.Random(5)
    receiver.takes = lambda number: dice.random() < 0.7
    await listening(mesh, sender, receiver)
    sent = 0
    for _ in range(300):
        for _ in range(dice.choice((1, 1, 1, 5, 40))):
            sender.put(KEY, sent.to_bytes(4, "big") + bytes(dice.choice((0, 100, 30_000))), Traffic.CALL)
            sent += 1
        await asyncio.sleep(dice.choice((0, PAUSE_S, 0.003)))
    await until(lambda: len(receiver.numbers) >= sent)
    await asyncio.sleep(0.1)
    assert receiver.numbers == list(range(sent))
    assert receiver.at_once > 20
    assert receiver.batches


async def test_a_burst_is_handled_in_batches(mesh: Mesh, sender: Mesh) -> None:
    """What comes in quick succession goes to the loop, many at a time."""
    receiver = Receiver()
    await listening(mesh, sender, receiver)
    for i in range(5000):
        sender.put(KEY, i.to_bytes(4, "big"))
    await until(lambda: len(receiver.numbers) == 5000)
    assert receiver.numbers == list(range(5000))
    assert receiver.at_once < 500
    assert len(receiver.batches) < 2500


async def test_nothing_overtakes_what_the_loop_is_handling(mesh: Mesh, sender: Mesh) -> None:
    """While the loop is in the middle of a batch, single samples wait for their turn."""
    receiver = Receiver()
    await listening(mesh, sender, receiver)

    def slow(batch: Iterator[Sample]) -> None:
        for i in range(10, 13):  # they arrive in Zenoh's thread while this goes on
            sender.put(KEY, i.to_bytes(4, "big"), Traffic.COMMAND)
            time.sleep(0.05)
        receiver.numbers += [number(payload) for _, payload in batch]

    mesh.subscribe(OTHER_KEY, slow)
    mesh.put(OTHER_KEY, (9).to_bytes(4, "big"))
    await until(lambda: 12 in receiver.numbers)
    assert receiver.numbers == [9, 10, 11, 12]
    assert receiver.at_once == 0


async def test_no_sample_goes_past_a_question(mesh: Mesh, sender: Mesh) -> None:
    """An emergency stop may be a query: while it waits for the loop, commands wait there as well."""
    receiver = Receiver()
    await listening(mesh, sender, receiver)
    key = CALL.of(type="ros", id=7, verb="stop", from_type="unity", from_id=256)

    async def stop(_key: str, _payload: bytes) -> bytes:
        receiver.numbers.append(-1)
        return b""

    mesh.serve(key, stop)
    while not receiver.numbers:
        with suppress(NotServed):
            await sender.query(key, b"", timeout_s=PATIENCE_S)
    receiver.numbers.clear()
    asked = asyncio.create_task(sender.query(key, b"", timeout_s=PATIENCE_S))
    await asyncio.sleep(0)  # it is asked now
    deadline = time.monotonic() + PATIENCE_S
    while not mesh._arrivals.asked and time.monotonic() < deadline:  # the loop stands still
        time.sleep(0.005)
    for i in range(3):  # and the loop of who is asked has something else to do
        time.sleep(0.05)
        sender.put(KEY, i.to_bytes(4, "big"), Traffic.COMMAND)
    time.sleep(0.05)
    await asked
    await until(lambda: len(receiver.numbers) == 4)
    assert sorted(receiver.numbers) == [-1, 0, 1, 2]
    assert receiver.at_once == 0


async def test_own_and_large_samples_go_to_the_loop(mesh: Mesh, sender: Mesh) -> None:
    """A put of this program is not handled within itself; what is large does not hold up the link."""
    receiver = Receiver()
    await listening(mesh, sender, receiver)
    mesh.put(KEY, (1).to_bytes(4, "big"), Traffic.COMMAND)
    await until(lambda: receiver.numbers == [1])
    sender.put(KEY, (2).to_bytes(4, "big") + bytes(Arrivals.AT_ONCE_BYTES), Traffic.COMMAND)
    await until(lambda: receiver.numbers == [1, 2])
    assert receiver.at_once == 0


async def test_an_error_costs_one_sample(mesh: Mesh, sender: Mesh, caplog: pytest.LogCaptureFixture) -> None:
    """A fault of ours in Zenoh's thread is told, and what follows arrives."""
    receiver = Receiver()
    await listening(mesh, sender, receiver)

    def fails_once(number: int) -> bool:
        if number == 1:
            raise ValueError("a fault of ours")
        return True

    receiver.takes = fails_once
    for i in range(1, 4):
        sender.put(KEY, i.to_bytes(4, "big"), Traffic.COMMAND)
        await asyncio.sleep(0.02)
    await until(lambda: receiver.numbers == [2, 3])
    assert "a fault of ours" in caplog.text


async def test_threads_of_zenoh_stay_attached(mesh: Mesh, sender: Mesh) -> None:
    """A thread keeps what Python knows of it from one callback to the next: making that anew costs five times more
    than the callback itself."""
    local = threading.local()
    counts: list[int] = []

    def one(_key: str, _payload: Payload) -> bool:
        local.count = getattr(local, "count", 0) + 1
        counts.append(local.count)
        return True

    mesh.subscribe(KEY, lambda batch: None, at_once=one)
    for _ in range(30):
        sender.put(KEY, b"x", Traffic.COMMAND)
        await asyncio.sleep(0.01)
    assert max(counts) > 5


async def test_who_makes_room_wakes_the_loop_once(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """However often what waits is handed over to make room, the loop is asked once to hand over the rest."""
    arrivals, handed_over = mesh._arrivals, 0
    deliver = arrivals._deliver

    def counted() -> None:
        nonlocal handed_over
        handed_over += 1
        deliver()

    monkeypatch.setattr(arrivals, "_deliver", counted)
    receiver = Receiver()
    mesh.subscribe(KEY, receiver.batch)
    await asyncio.sleep(0.1)
    count = 50 * (Arrivals.LOOPED + 1)
    for sent in range(count):
        mesh.put(KEY, sent.to_bytes(4, "big"), Traffic.CALL)
        mesh.make_room()
    await until(lambda: len(receiver.numbers) == count)
    await asyncio.sleep(0.1)
    assert receiver.numbers == list(range(count))
    assert handed_over <= 2


class Admitting:
    """A gate that takes everything at once, and notes what it took."""

    def __init__(self, taken: list[int]) -> None:
        self.taken = taken
        self.rescued: list[int] = []

    def admits(self, key: str, size: int, urgent: bool, now: float) -> bool:
        return True

    def age(self, key: str, clock: Hashable, stamp: float, now: float) -> float:
        return 0.0

    def first(self, key: str, payload: Payload, age_s: float, now: float) -> bool:
        self.taken.append(number(payload))
        return True

    def rescue(self, key: str, payload: Payload, now: float) -> None:
        self.rescued.append(number(payload))


def held_up_until(condition: Callable[[], object]) -> None:
    """The loop is held up, but not Zenoh's threads."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)


async def test_nothing_overtakes_a_large_command(mesh: Mesh, sender: Mesh) -> None:
    """A sample too large to be taken in Zenoh's thread waits for the loop, and those of its sender behind it; a stop
    among these is looked for at once. Afterwards samples are taken at once again."""
    taken: list[int] = []
    gate = Admitting(taken)

    def handle(batch: Iterator[tuple[str, Payload, float, float]]) -> None:
        taken.extend(number(payload) for _, payload, _, _ in batch)

    mesh.subscribe_guarded(KEY, handle, gate)
    await matched(sender, KEY)
    sender.put(KEY, (1).to_bytes(4, "big") + bytes(200_000), Traffic.CALL)
    sender.put(KEY, (2).to_bytes(4, "big"), Traffic.CALL)
    await asyncio.sleep(0)
    time.sleep(0.3)
    assert taken == []
    assert gate.rescued == [2]
    await until(lambda: len(taken) == 2)
    assert taken == [1, 2]
    sender.put(KEY, (3).to_bytes(4, "big"), Traffic.CALL)
    time.sleep(0.3)
    assert taken == [1, 2, 3]
