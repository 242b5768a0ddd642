"""docs/awareness.md: its files are written as they stand there, every command is run, every output compared."""

from __future__ import annotations

import asyncio
import os
import re
import shlex
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from tests.support.programs import ROOT, free_port
from tests.support.waiting import PATIENCE_S, until

PAGE = (ROOT / "docs" / "awareness.md").read_text(encoding="utf-8")
STAYS = ("macs router", "macs awareness", "python listener.py", "python planner.py")
"""What runs until it is stopped."""


class Reader:
    """The page's reader: a folder, a shell, and what was shown."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder = folder
        self.shown: list[str] = []
        self.log: list[str] = []
        self._endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._domain = domain
        self._running: list[asyncio.subprocess.Process] = []
        self._tasks: list[asyncio.Task[None]] = []

    def write(self, name: str, text: str) -> None:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(self._here(text))

    async def run(self, line: str) -> None:
        """One command: to its end, or until it is ready if it is one that stays."""
        argv = shlex.split(self._here(line))
        env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(self.folder / "installed")])}
        while "=" in argv[0]:
            name, _, value = argv.pop(0).partition("=")
            env[name] = str(self._domain + 100 * (int(value) - 1))
        install = argv[-1] == "--install"
        if install:  # not into the environment that runs the tests
            argv.pop()
        command = {"macs": [sys.executable, "-m", "bridge"], "python": [sys.executable]}[argv[0]]
        process = await asyncio.create_subprocess_exec(
            *(*command, *argv[1:]),
            cwd=self.folder,
            env=env,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        stays = any(text in line for text in STAYS)
        reading = [asyncio.create_task(self._read(p, into)) for p, into in self._outputs(process)]
        if stays:
            self._running.append(process)
            self._tasks += reading
            if "macs" in line:
                before = len(self.shown)
                await until(lambda: any(text.startswith("ready: ") for text in self.shown[before:]))
            return
        assert await asyncio.wait_for(process.wait(), 60) == 0, self.log
        await asyncio.gather(*reading)
        if install:
            (wheel,) = (self.folder / "dist").glob("*.whl")
            pip = [sys.executable, "-m", "pip", "install", "--no-index", "--no-deps", "--target", "installed"]
            await asyncio.to_thread(
                subprocess.run, [*pip, str(wheel)], cwd=self.folder, check=True, capture_output=True
            )

    async def stop(self) -> None:
        for process in reversed(self._running):
            if process.returncode is None:
                process.terminate()
            await asyncio.wait_for(process.wait(), PATIENCE_S)
        for task in self._tasks:
            task.cancel()

    def _here(self, text: str) -> str:
        return text.replace("tcp/127.0.0.1:7447", self._endpoint)

    def _outputs(self, process: asyncio.subprocess.Process) -> list[tuple[asyncio.StreamReader, list[str]]]:
        assert process.stdout is not None
        assert process.stderr is not None
        return [(process.stdout, self.shown), (process.stderr, self.log)]

    @staticmethod
    async def _read(stream: asyncio.StreamReader, into: list[str]) -> None:
        while line := await stream.readline():
            into.append(line.decode().rstrip())


@asynccontextmanager
async def reader(folder: Path, domain: int) -> AsyncIterator[Reader]:
    """Somebody who reads the page."""
    somebody = Reader(folder, domain)
    try:
        yield somebody
    finally:
        await somebody.stop()


def blocks() -> list[tuple[str, str, str]]:
    """The page's code blocks in order: the file's name if it is one, the language, the text."""
    found = re.findall(r"(?:^`([\w./]+)`:\n\n)?^```(\w+)\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    return [(name, language, text) for name, language, text in found]


async def test_the_page_from_top_to_bottom(tmp_path: Path, domain: int) -> None:
    """Every file, every command and every output of the page, in its order."""
    commands = 0
    async with reader(tmp_path, domain) as somebody:
        for name, language, text in blocks():
            if name:
                somebody.write(name, text)
            elif language == "sh":
                for line in text.splitlines():
                    await somebody.run(line)
                    commands += 1
            elif language == "text":
                for line in text.splitlines():
                    await until(lambda line=line: line in somebody.shown)
        table = [line.split() for line in somebody.shown if "drone" in line and "ros" in line.split()[:1]]
        assert [(row[1], row[-1]) for row in table] == [("1", "drone0"), ("2", "drone1")]
        assert not [line for line in somebody.log if "Traceback" in line]
    assert commands == 11
