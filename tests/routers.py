"""Zenoh routers as processes: zenohd where it is installed, otherwise the same router out of the Python wheel."""

from __future__ import annotations

import asyncio
import os
import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from tests.programs import ROOT, STOP_S, free_port

START_S = 30.0
LINE_BYTES = 4 << 20
"""zenohd logs its whole configuration, with every access rule, as one line."""


def zenohd() -> str | None:
    """Where zenohd is: on PATH, or where cargo installs it."""
    beside_cargo = Path(os.environ.get("CARGO_HOME", Path.home() / ".cargo")) / "bin" / "zenohd"
    return shutil.which("zenohd") or (str(beside_cargo) if beside_cargo.exists() else None)


class Router:
    """A router, listening when the block is entered, gone when it is left. It may be killed and started again."""

    def __init__(
        self,
        config: Path | None = None,
        *,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        overrides: Sequence[str] = (),
        within: Sequence[str] = (),
        host: str = "127.0.0.1",
    ) -> None:
        """``overrides`` are ``path:JSON5``; ``within`` comes before the command, as ``ip netns exec site``.

        Without ``listen`` and ``config`` it listens on a free port of ``host``.
        """
        if not listen and config is None:
            listen = [f"tcp/{host}:{free_port()}"]
        self.endpoint = listen[0] if listen else ""
        binary = zenohd()
        command = [binary, "--no-multicast-scouting"] if binary else [sys.executable, "-m", "bridge", "router"]
        if config is not None:
            command += ["-c", str(config)]
        for flag, values in (("-l", listen), ("-e", connect), ("--cfg", overrides)):
            command += [word for value in values for word in (flag, value)]
        self._command = [*within, *command]
        self._process: asyncio.subprocess.Process
        self._reading: list[asyncio.Task[None]] = []
        self.log: list[str] = []

    async def __aenter__(self) -> Router:
        await self.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.stop()

    async def start(self) -> None:
        """Start it, or start it again, and wait until it accepts sessions."""
        pipe = asyncio.subprocess.PIPE
        env = {"RUST_LOG": "info", **os.environ}
        self._process = await asyncio.create_subprocess_exec(
            *self._command, cwd=ROOT, env=env, stdout=pipe, stderr=pipe, limit=LINE_BYTES
        )
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        listening = asyncio.Event()
        self._reading = [
            asyncio.create_task(self._read(stream, listening))
            for stream in (self._process.stdout, self._process.stderr)
        ]
        waiting = asyncio.create_task(listening.wait())
        ended = asyncio.create_task(self._process.wait())
        await asyncio.wait([waiting, ended], timeout=START_S, return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        ended.cancel()
        assert listening.is_set(), f"{' '.join(self._command)} did not start: {self.log[-10:]}"

    async def _read(self, stream: asyncio.StreamReader, listening: asyncio.Event) -> None:
        while line := (await stream.readline()).decode(errors="replace").rstrip():
            self.log.append(line)
            if line.startswith("ready: ") or "Zenoh can be reached at" in line:
                listening.set()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal to it, and to nothing else."""
        self._process.send_signal(number)

    async def stop(self, number: signal.Signals = signal.SIGTERM) -> None:
        """Stop it, or kill it with SIGKILL."""
        if self._process.returncode is None:
            self._process.send_signal(number)
        try:
            await asyncio.wait_for(self._process.wait(), STOP_S)
        except asyncio.TimeoutError:
            self._process.kill()
            await self._process.wait()
        finally:
            for task in self._reading:
                task.cancel()
