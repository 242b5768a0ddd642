"""The programs that ``macs up`` runs: started, restarted with growing pauses, stopped in order, logs prefixed."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress

from bridge.cli import output
from bridge.cli.running import READY, STOP_WITH_STDIN
from bridge.logs import FORMAT, SHORT, TEXT
from macs_zenoh.errors import MacsError
from macs_zenoh.timeouts import within

log = logging.getLogger("macs.up")

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 8.0
LONGEST_LINE = 1 << 20
GOOD_LIFE_S = 30.0
"""A child that lived so long starts again with the first pause."""
WRONG_USAGE = 2
"""Exit code for usage and configuration errors: the next attempt would end the same way."""

START_S = 5.0
"""A child that ends within this time of its first start, without ever being ready, has a cause that stays."""


class ChildFailed(MacsError):
    """A program of ``macs up`` cannot work here, so that nothing is gained by starting it again."""

    def __init__(self, name: str, code: int) -> None:
        super().__init__(f"{name} ended at once with exit code {code}, its last lines are above")
        self.name = name
        self.code = code


PREFIX_WIDTH = 8


def prefix(name: str) -> str:
    """What stands before the log lines of a program."""
    return f"{name:{PREFIX_WIDTH}}| "


class Child:
    """One program: this Python again with another verb, kept alive until `stop`."""

    def __init__(self, name: str, argv: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
        """``argv`` follows ``python -m``. ``environment``: None is ours."""
        self.name = name
        self.environment = environment
        self.argv = [sys.executable, "-m", *argv]
        self.ready = asyncio.Event()
        """Set by the line `READY`, and never cleared."""
        self.starts = 0
        self._prefix = prefix(name)
        self._process: asyncio.subprocess.Process | None = None
        self._stopping = False

    async def run(self) -> None:
        """Keep the program running. Raises `ChildFailed` when it cannot work; returns after `stop`."""
        loop = asyncio.get_running_loop()
        pause_s = FIRST_PAUSE_S
        while not self._stopping:
            started = loop.time()
            code = await self._run_once()
            if self._stopping:
                return
            lived_s = loop.time() - started
            if code == WRONG_USAGE or (not self.ready.is_set() and self.starts == 1 and lived_s < START_S):
                raise ChildFailed(self.name, code)
            if lived_s > GOOD_LIFE_S:
                pause_s = FIRST_PAUSE_S
            log.warning("%s ended with exit code %d, starts again in %.1f s", self.name, code, pause_s)
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    async def stop(self, within_s: float) -> None:
        """SIGTERM, then SIGKILL when it is still there after ``within_s``."""
        self._stopping = True
        process = self._process
        if process is None or process.returncode is not None:
            return
        with suppress(ProcessLookupError):
            process.send_signal(signal.SIGTERM)
        try:
            await within(process.wait(), within_s)
        except asyncio.TimeoutError:
            log.warning("%s did not stop within %.1f s, killed", self.name, within_s)
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()

    async def _run_once(self) -> int:
        self.starts += 1
        # Its own session: Ctrl-C reaches only us, so that the router goes last. Its stdin ends when we do.
        environment = os.environ if self.environment is None else self.environment
        self._process = process = await asyncio.create_subprocess_exec(
            *self.argv,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            start_new_session=True,
            limit=LONGEST_LINE,
            env={
                FORMAT: SHORT if sys.stderr.isatty() else TEXT,  # unless something is said
                **environment,
                STOP_WITH_STDIN: "1",
                "PYTHONUNBUFFERED": "1",
            },
        )
        assert process.stdout is not None
        async for line in process.stdout:
            self._pass_on(line.decode(errors="replace").rstrip())
        return await process.wait()

    def _pass_on(self, line: str) -> None:
        output.note(f"{self._prefix}{line}")
        if line.startswith(READY):
            self.ready.set()


async def stop_in_order(stages: Iterable[tuple[Iterable[Child], float]]) -> None:
    """Stop stage after stage, the children of one stage together: those that need a router before the router."""
    for children, within_s in stages:
        await asyncio.gather(*(child.stop(within_s) for child in children))
