"""The program of a headset under test, where the kit runs it."""

from __future__ import annotations

import asyncio
import shlex

from macs_zenoh.errors import UsageError
from macs_zenoh.timeouts import within

_STOP_S = 5.0


class Command:
    """A command line in which ``{port}`` stands for the kit's port. What it prints goes nowhere."""

    def __init__(self, line: str) -> None:
        self._words = shlex.split(line)
        if not self._words:
            raise UsageError("the command is empty")
        self._process: asyncio.subprocess.Process | None = None

    async def start(self, port: int) -> None:
        """Start it, after an earlier one has ended. Raises UsageError."""
        await self.stop()
        words = [word.replace("{port}", str(port)) for word in self._words]
        null = asyncio.subprocess.DEVNULL
        try:
            self._process = await asyncio.create_subprocess_exec(*words, stdin=null, stdout=null, stderr=null)
        except OSError as error:
            raise UsageError(f"{words[0]}: {error.strerror}") from error

    async def stop(self) -> bool:
        """Ask it to stop, and kill it where it does not. Whether it ended by itself."""
        if self._process is None:
            return False
        if self._process.returncode is None:
            self._process.terminate()
            try:
                await within(self._process.wait(), _STOP_S)
            except asyncio.TimeoutError:
                self._process.kill()
        return await self._process.wait() >= 0
