"""The project's own programs as processes, for tests: each announces itself on stdout, each is stopped by its pid."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

ROOT = Path(__file__).parents[1]
START_S = 20.0
STOP_S = 5.0


def free_port() -> int:
    """A port of 127.0.0.1 that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Program:
    """``macs VERB ...`` in a process of its own, ready when the block is entered, gone when it is left."""

    def __init__(self, *argv: str, env: Mapping[str, str] | None = None, within: Sequence[str] = ()) -> None:
        """``within`` comes before the command, as ``ip netns exec site``."""
        self.argv = argv
        self.ready = ""
        """What it said when it was ready, e.g. ``gateway on 127.0.0.1:7000``."""
        self.log: list[str] = []
        self._env = {**os.environ, **(env or {})}
        self._within = within
        self._process: asyncio.subprocess.Process
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Program:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()

    async def start(self) -> None:
        """Start it and wait until it says that it is ready."""
        self._process = await asyncio.create_subprocess_exec(
            *self._within,
            sys.executable,
            "-m",
            "bridge",
            *self.argv,
            cwd=ROOT,
            env=self._env,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        self._tasks = [asyncio.create_task(self._keep_log())]
        assert self._process.stdout is not None
        line = (await asyncio.wait_for(self._process.stdout.readline(), START_S)).decode()
        assert line.startswith("ready: "), f"macs {' '.join(self.argv)} did not start: {self.log}"
        self.ready = line.removeprefix("ready: ").strip()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def port(self) -> int:
        """The port in what it said when it was ready."""
        return int(self.ready.rpartition(":")[2])

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal to it, and to nothing else."""
        self._process.send_signal(number)

    async def wait(self) -> int:
        """Wait until it ends by itself; its exit code."""
        return await self._process.wait()

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Stop it; its exit code. A program that does not stop in time is killed, and that is an error."""
        if self._process.returncode is None:
            self._process.send_signal(number)
        try:
            return await asyncio.wait_for(self._process.wait(), STOP_S)
        except asyncio.TimeoutError:
            self._process.kill()
            await self._process.wait()
            raise AssertionError(f"macs {' '.join(self.argv)} did not stop: {self.log[-5:]}") from None
        finally:
            for task in self._tasks:
                task.cancel()

    async def _keep_log(self) -> None:
        assert self._process.stderr is not None
        while line := await self._process.stderr.readline():
            self.log.append(line.decode(errors="replace").rstrip())


async def ended(*argv: str) -> tuple[int | None, str, str]:
    """Run ``macs ...`` to its end: exit code, stdout, stderr."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "bridge", *argv, cwd=ROOT, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
    )
    out, errors = await asyncio.wait_for(process.communicate(), START_S)
    return process.returncode, out.decode(), errors.decode()


async def macs(*argv: str) -> Any:
    """Run ``macs ...`` to its end and return its stdout as JSON. Fails unless it exits with 0."""
    code, out, errors = await ended(*argv)
    assert code == 0, errors
    return json.loads(out)
