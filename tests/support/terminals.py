"""A verb of ``macs`` in a terminal of its own, as a person has it."""

from __future__ import annotations

import asyncio
import fcntl
import os
import pty
import struct
import sys
import termios
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

from tests.support.processes import ROOT
from tests.support.waiting import PATIENCE_S

ROWS = 24


@dataclass
class Terminal:
    """What was drawn so far is in ``seen``, how the terminal was set before in ``before``."""

    process: asyncio.subprocess.Process
    seen: bytearray
    before: list[Any]
    own: int
    its: int

    def type(self, keys: bytes) -> None:
        """Press keys."""
        os.write(self.own, keys)

    @property
    def settings(self) -> list[Any]:
        """How it is set now."""
        return termios.tcgetattr(self.its)

    async def ended(self) -> int:
        """Its exit code."""
        return await asyncio.wait_for(self.process.wait(), PATIENCE_S)


@asynccontextmanager
async def terminal(*argv: str, columns: int = 80) -> AsyncIterator[Terminal]:
    """``macs`` with these words, in so many columns; killed where it has not ended."""
    own, its = pty.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, columns, 0, 0))
    before = termios.tcgetattr(its)
    seen = bytearray()
    loop = asyncio.get_running_loop()
    loop.add_reader(own, lambda: seen.extend(os.read(own, 65536)))
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "bridge", *argv),
        cwd=ROOT,
        stdin=its,
        stdout=its,
        stderr=its,
        env={**os.environ, "TERM": "xterm"},
    )
    try:
        yield Terminal(process, seen, before, own, its)
    finally:
        loop.remove_reader(own)
        if process.returncode is None:
            process.kill()
            await process.wait()
        os.close(own)
        os.close(its)
