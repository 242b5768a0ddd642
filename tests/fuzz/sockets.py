"""Mutated frames over real sockets against a gateway process, beside two well-behaved headsets.

``python -m tests.fuzz.sockets --frames 1000000 --seed 7`` starts a router and a gateway, sends mutations of every
recorded frame over many connections, and meanwhile has two headsets exchange numbered messages. In the end: the
gateway still runs, the neighbours' messages all came in order, and no thread or descriptor is left over.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import struct
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from bridge.headset.client import Headset
from tests.support.programs import Program, free_port
from tests.support.waiting import PATIENCE_S

VECTORS = Path(__file__).parents[1] / "vectors"
CONNECTIONS = 8
PER_CONNECTION = 2_000
GONE_S = 15.0
"""How long the last attackers' connections may take to be gone: a half-sent frame waits for the silence limit."""
PACE_S = 0.005
"""Between a neighbour's messages."""


class Report(NamedTuple):
    """What came of it."""

    frames: int
    connections: int
    neighbour_messages: int
    seconds: float
    threads: tuple[int, int]
    descriptors: tuple[int, int]
    log: list[str]


def recorded() -> list[bytes]:
    """Every recorded frame from an agent to the router."""
    frames = []
    for path in sorted(VECTORS.glob("*/*.json")):
        for line in json.loads(path.read_text()):
            if line["dir"] == "agent->router" and line["hex"]:
                frames.append(bytes.fromhex(line["hex"]))
    return [frame for frame in frames if 39 <= len(frame) <= 4096]


def mutate(frame: bytes, random: random.Random) -> bytes:
    """One broken frame. Most keep their outer sizes, so that what follows on the connection is still read."""
    data = bytearray(frame)
    kind = random.random()
    if kind < 0.80:  # bytes inside: JSON, inner sizes, destinations
        for _ in range(random.choice((1, 1, 2, 8))):
            at = random.randrange(len(data))
            if not 31 <= at < 39:
                data[at] = random.choice((0, 0xFF, 0x7B, 0x22, random.randrange(256)))
    elif kind < 0.90:  # another inner size
        at = 39 + struct.unpack_from("<I", data, 31)[0]
        if at + 4 <= len(data):
            struct.pack_into("<I", data, at, random.choice((0, 1, len(data), 0x7FFFFFFF, 0xFFFFFFFF)))
    elif kind < 0.9995:  # a cut or longer body with honest outer sizes
        size = struct.unpack_from("<I", data, 31)[0]
        body = bytes(data[39 + size :])
        body = body[: random.randrange(len(body) + 1)] if random.random() < 0.5 else body + os.urandom(8)
        data = bytearray(data[:35] + struct.pack("<I", len(body)) + data[39 : 39 + size] + body)
    else:  # outer sizes that lie: this connection ends here, or waits for what never comes
        struct.pack_into("<I", data, random.choice((31, 35)), random.getrandbits(32))
    return bytes(data)


async def attack(port: int, frames: Iterator[bytes]) -> int:
    """Send frames on one connection until it ends or has sent its share; how many were sent."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    draining = asyncio.create_task(_drain(reader))
    sent = 0
    with suppress(ConnectionError):
        for frame in frames:
            writer.write(frame)
            sent += 1
            if sent % 50 == 0:
                await writer.drain()
                await asyncio.sleep(0)
            if sent >= PER_CONNECTION or draining.done() or writer.is_closing():
                break
        await asyncio.wait_for(writer.drain(), PATIENCE_S)
    writer.close()
    draining.cancel()
    return sent


async def _drain(reader: asyncio.StreamReader) -> None:
    with suppress(ConnectionError):
        while await reader.read(65536):
            pass


async def run(frames: int, seed: int) -> Report:
    """Do it. Raises AssertionError when anything was not as it should be."""
    source = random.Random(seed)
    material = recorded()
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with (
        Program("router", "-l", endpoint),
        Program("gateway", "--port", "0", "-e", endpoint) as gateway,
        await Headset.connect("127.0.0.1", gateway.port) as left,
        await Headset.connect("127.0.0.1", gateway.port) as right,
    ):
        before = _threads(gateway.pid), _descriptors(gateway.pid)
        begun = time.monotonic()
        talk = asyncio.create_task(_talk(left, right))
        listen = asyncio.create_task(_count_in_order(right, left))
        sent = connections = 0

        def stream() -> Iterator[bytes]:
            while True:
                yield mutate(source.choice(material), source)

        while sent < frames:
            shares = await asyncio.gather(*(attack(gateway.port, stream()) for _ in range(CONNECTIONS)))
            sent += sum(shares)
            connections += len(shares)
        talk.cancel()
        await left.send(b"end", to=2, ids=[right.id], manager="Neighbour")
        messages = await asyncio.wait_for(listen, PATIENCE_S)
        deadline, both = time.monotonic() + GONE_S, [left.id, right.id]
        online = (await left.online()).unity_agent_ids
        # what an attacker said last may wait for its turn when its socket has ended
        while (online != both or _descriptors(gateway.pid) > before[1]) and time.monotonic() < deadline:
            await asyncio.sleep(0.1)
            online = (await left.online()).unity_agent_ids
        assert online == both, "an attacker is still online"
        after = _threads(gateway.pid), _descriptors(gateway.pid)
        # one more is the thread for large messages, which starts with the first of them
        assert after[0]["python"] <= before[0]["python"] + 1, f"threads: {before[0]} → {after[0]}"
        assert after[1] <= before[1], f"descriptors: {before[1]} → {after[1]}"
        bad = [line for line in gateway.log if "Traceback" in line or " E " in line]
        assert not bad, bad[:3]
        seconds = time.monotonic() - begun
        threads = before[0].total(), after[0].total()
        return Report(sent, connections, messages, seconds, threads, (before[1], after[1]), gateway.log[-3:])


async def _talk(left: Headset, right: Headset) -> None:
    number = 0
    while True:
        await left.send(b"%d" % number, to=2, ids=[right.id], manager="Neighbour")
        number += 1
        await asyncio.sleep(PACE_S)


async def _count_in_order(right: Headset, left: Headset) -> int:
    """All numbered messages that came, which must be 0, 1, 2, …: what attackers broadcast lies between them."""
    expected = 0
    while True:
        message = await right.receive()
        if message.metadata.message_manager != "Neighbour" or message.sender_id != left.id:
            continue
        if bytes(message.data) == b"end":
            return expected
        assert bytes(message.data) == b"%d" % expected, f"{bytes(message.data)!r} instead of {expected}"
        expected += 1


def _threads(pid: int) -> Counter[str]:
    """Threads by name: a subscription of ours is a thread called python, Zenoh starts a few more of its own late."""
    return Counter((task / "comm").read_text().strip() for task in Path(f"/proc/{pid}/task").iterdir())


def _descriptors(pid: int) -> int:
    return len(list(Path(f"/proc/{pid}/fd").iterdir()))


def main() -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    options = parser.parse_args()
    print(f"seed {options.seed}")
    print(asyncio.run(run(options.frames, options.seed)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
