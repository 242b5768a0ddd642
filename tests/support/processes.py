"""A program in a process of its own: ready when its block is entered, gone when it is left, stopped by its pid.

What it says is read all the time, so that it never waits for who reads; a program that does not start or stop tells
the end of its log.
"""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TypeVar

from tests.support.forks import ROOT as ROOT
from tests.support.forks import Forked, started

START_S = 60.0
"""By when a program is ready, on a machine that has much else to do."""
STOP_S = 20.0
"""By when one that was told to stop has ended; how soon that is when nothing else runs is for tests of its own."""
SHOWN = 20
"""How many lines of a log a failure shows."""

Self = TypeVar("Self", bound="Process")


class Process:
    """It may be killed, and started again."""

    def __init__(self, *command: str, env: Mapping[str, str] | None = None, within: Sequence[str] = ()) -> None:
        """``within`` comes before the command, as ``ip netns exec site``; ``env`` is beside what is set here."""
        self.command = (*within, *command)
        self.said: list[str] = []
        """What it wrote to standard output."""
        self.log: list[str] = []
        """What it wrote to standard error."""
        self._env = {**os.environ, **(env or {})}
        self._process: asyncio.subprocess.Process | Forked
        self._reading: list[asyncio.Task[None]] = []
        self._ready: asyncio.Event
        self._stdin: int | None = None

    def __str__(self) -> str:
        return " ".join(self.command)

    async def __aenter__(self: Self) -> Self:
        try:
            await self.start()
        except BaseException:
            await self._kill()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()

    async def start(self) -> None:
        """Start it, or start it again, and wait until it says that it is ready."""
        self._ready = asyncio.Event()
        self._process = await started(self.command, self._env, self._stdin)
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._reading = [
            asyncio.create_task(self._read(self._process.stdout)),
            asyncio.create_task(self._read(self._process.stderr, is_log=True)),
        ]
        ready = asyncio.create_task(self._ready.wait())
        ended = asyncio.create_task(self._process.wait())
        await asyncio.wait([ready, ended], timeout=START_S, return_when=asyncio.FIRST_COMPLETED)
        if ended.done():
            await asyncio.wait(self._reading)
        for waiting in (ready, ended):
            waiting.cancel()
        assert self._ready.is_set(), f"{self} {self._state} and was not ready: {self.tail}"

    @property
    def tail(self) -> list[str]:
        """The last lines of its log."""
        return self.log[-SHOWN:]

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal to it, and to nothing else."""
        self._process.send_signal(number)

    async def wait(self) -> int:
        """Wait until it ends by itself; its exit code."""
        return await self._process.wait()

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Stop it; its exit code. One that does not stop in time is killed, and that is an error."""
        if self._process.returncode is None:
            self._end(number)
        try:
            return await asyncio.wait_for(self._process.wait(), STOP_S)
        except asyncio.TimeoutError:
            await self._kill()
            raise AssertionError(f"{self} did not stop: {self.tail}") from None
        finally:
            for task in self._reading:
                task.cancel()

    def _end(self, number: signal.Signals) -> None:
        """Tell it to stop."""
        self._process.send_signal(number)

    def _heard(self, line: str, *, is_log: bool) -> bool:
        """Take a line that it said; whether it is ready now."""
        return not is_log and line.startswith("ready: ")

    @property
    def _state(self) -> str:
        code = self._process.returncode
        return f"has run for {START_S:g} s" if code is None else f"ended with {code}"

    async def _kill(self) -> None:
        process = getattr(self, "_process", None)
        if process is not None and process.returncode is None:
            process.kill()
            await process.wait()

    async def _read(self, stream: asyncio.StreamReader, *, is_log: bool = False) -> None:
        while raw := await stream.readline():
            line = raw.decode(errors="replace").rstrip()
            (self.log if is_log else self.said).append(line)
            if self._heard(line, is_log=is_log):
                self._ready.set()


async def finished(*command: str, env: Mapping[str, str] | None = None) -> tuple[int, str, str]:
    """Run a command to its end: exit code, standard output, standard error. It is killed when it takes too long."""
    process = await started(command, {**os.environ, **(env or {})})
    try:
        out, errors = await asyncio.wait_for(process.communicate(), START_S)
    finally:
        if process.returncode is None:
            process.kill()
    assert process.returncode is not None
    return process.returncode, out.decode(errors="surrogateescape"), errors.decode(errors="surrogateescape")
