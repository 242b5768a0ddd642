"""A robot or a headset in a process of its own on another host, asked from a test line by line (JSON on its pipes).

::

    async with Inside("robot", connect=["tcp/10.213.0.1:7447"], within=host.within) as robot:
        await robot.ask("stream", topic="/camera", hz=30, size=120_000)
        got = await robot.ask("received", topic="/cmd_vel")

The processes are those of `tests.network.ends`. All hosts share one clock (CLOCK_MONOTONIC), so a message that carries
the time when it was sent tells on arrival how long it took.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, NamedTuple

from tests.programs import ROOT, START_S, STOP_S


class Received(NamedTuple):
    """One message as it arrived."""

    number: int
    """Counted by the sender, from 0."""
    sent_s: float
    """When it was sent, CLOCK_MONOTONIC."""
    took_s: float
    size: int
    sender: int


class Inside:
    """A process of `tests.network.ends`, ready when the block is entered, gone when it is left."""

    def __init__(self, end: str, *, within: Sequence[str] = (), **options: Any) -> None:
        self._command = [*within, sys.executable, "-m", "tests.network.ends", end, json.dumps(options)]
        self._process: asyncio.subprocess.Process
        self._errors: asyncio.Task[None]
        self._turn = asyncio.Lock()
        self.log: list[str] = []

    async def __aenter__(self) -> Inside:
        pipe = asyncio.subprocess.PIPE
        self._process = await asyncio.create_subprocess_exec(
            *self._command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=pipe, limit=64 << 20
        )
        self._errors = asyncio.create_task(self._keep_log())
        try:
            await self._answer(START_S)
        except BaseException:
            await self.stop()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()

    async def stop(self) -> None:
        """End it, and wait until it has ended."""
        if self._process.returncode is None:
            assert self._process.stdin is not None
            self._process.stdin.close()  # it ends with its input
        try:
            await asyncio.wait_for(self._process.wait(), STOP_S)
        except asyncio.TimeoutError:
            self._process.kill()
            await self._process.wait()
        self._errors.cancel()

    async def ask(self, what: str, timeout_s: float = 30.0, **arguments: Any) -> Any:
        """Call one of its methods and return the answer. AssertionError with its log when it fails."""
        async with self._turn:
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps([what, arguments]).encode() + b"\n")
            return await self._answer(timeout_s)

    async def received(self, topic: str) -> list[Received]:
        """What came on a topic since it was asked for the last time."""
        return [Received(*row) for row in await self.ask("received", topic=topic)]

    async def until_online(self, kind: str, number: int, timeout_s: float = 10.0) -> None:
        """Wait until this end sees an agent online."""
        await self._until("online", lambda agents: [kind, number] in agents, timeout_s)

    async def until_gone(self, kind: str, number: int, timeout_s: float = 20.0) -> None:
        """Wait until this end sees an agent no more."""
        await self._until("online", lambda agents: [kind, number] not in agents, timeout_s)

    async def until_registered(self, topic: str, timeout_s: float = 10.0) -> None:
        """Wait until a headset is registered for this robot's topic."""
        await self._until("registered", bool, timeout_s, topic=topic)

    async def until_received(self, topic: str, timeout_s: float = 10.0) -> list[Received]:
        """Wait until something has come on a topic; what."""
        rows = await self._until("received", bool, timeout_s, topic=topic)
        return [Received(*row) for row in rows]

    async def _until(self, what: str, right: Callable[[Any], bool], timeout_s: float, **arguments: Any) -> Any:
        deadline = time.monotonic() + timeout_s
        while not right(answer := await self.ask(what, **arguments)):
            assert time.monotonic() < deadline, f"{what} {arguments} is still {answer} after {timeout_s} s"
            await asyncio.sleep(0.02)
        return answer

    async def _answer(self, timeout_s: float) -> Any:
        assert self._process.stdout is not None
        line = await asyncio.wait_for(self._process.stdout.readline(), timeout_s)
        if not line:
            await asyncio.wait_for(self._process.wait(), STOP_S)
            await self._errors
        assert line, f"{' '.join(self._command)} ended: {self.log[-20:]}"
        answer = json.loads(line)
        assert "failed" not in answer, f"{answer['failed']} {self.log[-10:]}"
        return answer["done"]

    async def _keep_log(self) -> None:
        assert self._process.stderr is not None
        while line := await self._process.stderr.readline():
            self.log.append(line.decode(errors="replace").rstrip())


def quantile(values: Sequence[float], share: float) -> float:
    """The value that ``share`` of all do not exceed."""
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


def lost(received: Sequence[Received], first: int, after: int) -> int:
    """How many of the messages from ``first`` up to and not including ``after`` did not come."""
    return after - first - len({message.number for message in received if first <= message.number < after})


def longest_gap_s(received: Sequence[Received]) -> float:
    """The longest time between two arrivals."""
    arrivals = sorted(message.sent_s + message.took_s for message in received)
    return max((later - earlier for earlier, later in itertools.pairwise(arrivals)), default=0.0)


def median_ms(received: Sequence[Received]) -> float:
    """The median of the times that messages took."""
    return 1000 * statistics.median(message.took_s for message in received)
