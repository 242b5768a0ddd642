"""The programs that record and replay: each a process, told to end by its stdin or a signal, heard by its lines."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import sys
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from bridge.cli.running import READY, STOP_WITH_STDIN
from bridge.recording.room import FULL
from macs_zenoh.errors import Refused
from macs_zenoh.timeouts import within

log = logging.getLogger("macs.record")

START_S = 20.0
"""How long one may take to be ready: it joins the mesh."""
STOP_S = 10.0
ANSWER_S = 10.0
LONGEST_LINE = 1 << 20
LAST_LINES = 5


class Child:
    """One program, from `spawned` until it has ended. ``on_end`` is called then."""

    def __init__(self, process: asyncio.subprocess.Process, name: str, on_end: Callable[[Child], None]) -> None:
        self.name = name
        self.progress: dict[str, Any] = {}
        """What it said last of how it is getting on."""
        self._reasons: deque[str] = deque(maxlen=LAST_LINES)
        """Why its files ended."""
        self._process = process
        self._ready = asyncio.Event()
        self._answer: asyncio.Future[dict[str, str]] | None = None
        self._last: deque[str] = deque(maxlen=LAST_LINES)
        loop = asyncio.get_running_loop()
        self._tasks = [loop.create_task(self._hear()), loop.create_task(self._hear_log())]
        self._ended = loop.create_task(self._wait(on_end))

    @classmethod
    async def spawned(cls, words: Sequence[str], on_end: Callable[[Child], None]) -> Child:
        """A program that has begun, and is not `ready`: who keeps it knows it before it can have ended."""
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "bridge", *words),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            start_new_session=True,
            limit=LONGEST_LINE,
            env={**os.environ, STOP_WITH_STDIN: "1", "PYTHONUNBUFFERED": "1"},
        )
        return cls(process, words[0], on_end)

    async def ready(self) -> None:
        """Wait for it. Raises Refused with its last words: it has been ended."""
        ready = asyncio.ensure_future(self._ready.wait())
        try:
            await asyncio.wait([ready, self._ended], timeout=START_S, return_when=asyncio.FIRST_COMPLETED)
            if not self._ready.is_set():
                raise Refused(f"macs {self.name} did not begin: {self._words or f'not within {START_S:g} s'}")
        except BaseException:
            await self.stop()
            raise
        finally:
            ready.cancel()

    @property
    def is_ready(self) -> bool:
        """Whether it does its work."""
        return self._ready.is_set()

    @property
    def problem(self) -> str:
        """Why it ended, where it should not have; empty where it ended in order, or goes on."""
        code = self._process.returncode
        if not code:
            return FULL if FULL in self._reasons else ""
        if code < 0:
            return f"it was ended by signal {-code}"
        return (self._reasons[-1] if self._reasons else "") or self._words or f"exit code {code}"

    @property
    def _words(self) -> str:
        """Its last words."""
        return next((line for line in reversed(self._last) if line.startswith("macs")), "; ".join(self._last))

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        with suppress(ProcessLookupError):
            self._process.send_signal(number)

    async def ask_for_ring(self) -> dict[str, str]:
        """What becomes of the wish that it writes its ring: the ``file``. One at a time. Raises Refused."""
        if not self._ready.is_set():
            raise Refused("it has not begun yet")
        self._answer = asyncio.get_running_loop().create_future()
        try:
            self.signal(signal.SIGUSR2)
            waits: list[asyncio.Future[Any]] = [self._answer, self._ended]
            await asyncio.wait(waits, timeout=ANSWER_S, return_when=asyncio.FIRST_COMPLETED)
            told = self._answer.result() if self._answer.done() else {"refused": f"macs {self.name} does not answer"}
        finally:
            self._answer = None
        if "refused" in told:
            raise Refused(told["refused"])
        return told

    async def stop(self) -> None:
        """End it, as Ctrl-C does; killed when it does not."""
        self.signal(signal.SIGTERM)
        try:
            await within(asyncio.shield(self._ended), STOP_S)
        except asyncio.TimeoutError:
            log.warning("macs %s did not stop within %g s, killed", self.name, STOP_S)
            with suppress(ProcessLookupError):
                self._process.kill()
            await self._ended

    async def _hear(self) -> None:
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            text = line.decode(errors="replace").rstrip()
            if text.startswith(READY):
                self._ready.set()
            with suppress(ValueError):
                said = json.loads(text)
                if isinstance(said, dict) and "progress" in said:
                    self.progress = said["progress"]
                elif isinstance(said, dict) and "ring" in said:
                    if self._answer is not None and not self._answer.done():
                        self._answer.set_result(said["ring"])
                elif isinstance(said, dict) and "files" in said:
                    self._reasons.append(str(said.get("reason", "")))

    async def _hear_log(self) -> None:
        assert self._process.stderr is not None
        async for line in self._process.stderr:
            text = line.decode(errors="replace").rstrip()
            self._last.append(text)
            log.info("%s: %s", self.name, text)

    async def _wait(self, on_end: Callable[[Child], None]) -> None:
        await self._process.wait()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        on_end(self)
