"""Headsets that all connect in one moment, while robot programs are there: whether each gets an id, and when."""

from __future__ import annotations

import asyncio
import math
import resource
import time
from collections.abc import Iterator
from contextlib import suppress

from bridge.headset import frames
from macs_zenoh.protocol.decoders import MessageDecoder
from macs_zenoh.protocol.messages import ROS, Configuration, Welcome, decode_data, encode_management
from macs_zenoh.protocol.wire import encode_frame, split_message

from .figures import Figure
from .plan import Case, Plan
from .processes import Stage

HEADSETS, ROBOTS, BURSTS = 2000, 50, 50
PATIENCE_S = 60.0
REST_S = 0.3
PIECE = 64 << 10


class Agent:
    """A TCP agent that takes its id and says who it is, no more."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader = reader
        self._writer = writer
        self.id = 0

    @classmethod
    async def join(cls, port: int, address: str, *, robot: bool = False) -> Agent:
        """Connect from an address, and wait for the greeting."""
        agent = cls(*await asyncio.open_connection("127.0.0.1", port, local_addr=(address, 0)))
        decoder = MessageDecoder()
        while not (messages := decoder.feed(await agent._read())):
            pass
        agent.id = decode_data(Welcome, bytes(split_message(messages[0])[1])).agent_id
        told = encode_management(Configuration(ROS, agent.id, 0, 1))
        agent._writer.write(encode_frame(management=told) if robot else frames.configuration(agent.id, 0, 1))
        return agent

    async def _read(self) -> bytes:
        data = await self._reader.read(PIECE)
        if not data:
            raise EOFError("the connection was closed")
        return data

    async def stay(self) -> None:
        """Read what comes, and send heartbeats. Raises EOFError when it is closed."""
        while True:
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._read(), 1.0)
            self._writer.write(frames.heartbeat())

    def leave(self) -> None:
        """End the connection."""
        self._writer.close()


async def _burst(port: int, address: str, robots: list[Agent]) -> tuple[int, float]:
    """How many headsets have an id of their own, and in how many seconds they had."""
    began = time.monotonic()
    coming = [asyncio.ensure_future(Agent.join(port, address)) for _ in range(HEADSETS)]
    done, late = await asyncio.wait(coming, timeout=PATIENCE_S)
    took_s = time.monotonic() - began
    for each in late:
        each.cancel()
    headsets = [each.result() for each in done if each.exception() is None]
    ids = {each.id for each in headsets} - {each.id for each in robots}
    for headset in headsets:
        headset.leave()
    await asyncio.sleep(REST_S)
    return len(ids), took_s if len(ids) == HEADSETS else math.inf


async def _bursts(port: int, count: int) -> list[tuple[int, float]]:
    robots = [await Agent.join(port, "127.0.0.1", robot=True) for _ in range(ROBOTS)]
    staying = [asyncio.ensure_future(robot.stay()) for robot in robots]
    found = [await _burst(port, f"127.0.1.{number + 1}", robots) for number in range(count)]  # who comes back waits
    for each in staying:
        if each.done():
            await each  # it says why it did not stay
        each.cancel()
    return found


def burst(stage: Stage, plan: Plan) -> Iterator[Figure]:
    """2 000 headsets connect in one moment, with 50 robots there: each gets an id of its own, 50 of 50 times?"""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    port = stage.gateway(stage.router())
    count = max(1, round(BURSTS * plan.scale))
    found = asyncio.run(_bursts(port, count))
    plan.arrived("burst, ids", HEADSETS * count, sum(ids for ids, _ in found))
    whole = sum(ids == HEADSETS for ids, _ in found)
    yield Figure(f"bursts in which all {HEADSETS} had one", [whole], [count], "bursts", "", at_least=1.0)
    took = sorted(took_s for _, took_s in found)
    yield Figure("until all had one", took, [1.0] * count, "", "s")
    yield Figure("the same, the longest", took[-1:], [1.0], "", "s")


CASES: dict[str, Case] = {"burst": burst}
"""What takes minutes."""
