"""docs/deploy.md from top to bottom: its commands are run as they stand there, on real routers, with certificates.

What differs here: ports are free ones, machines are directories, and copying to one is copying. What NAT does to links
is in tests/network.
"""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge.headset.client import Headset
from tests.support.forks import LINE_BYTES
from tests.support.programs import ROOT, free_port
from tests.support.tools import zenohd
from tests.support.waiting import PATIENCE_S

PAGE = (ROOT / "docs" / "deploy.md").read_text(encoding="utf-8")

STAYS = ("macs router", "macs gateway", "macs agent", "zenohd", "python")
"""What runs until it is stopped."""
READY = {"macs": "ready: ", "zenohd": "can be reached at", "python": "demo robot:"}
"""How our programs, zenohd and the page's robot say that they do their work."""
CTRL_C = "# Ctrl-C "
"""And where, as the comment behind a command that stays says it."""
ANEW = ("One host", "A site", "Across networks")
"""Sections that begin with nothing running but the robot."""

pytestmark = pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="the page has a robot")


def commands() -> Iterator[tuple[str, str]]:
    """Each command of the page that is to be run, with its section."""
    for section in re.split(r"^## ", PAGE, flags=re.MULTILINE):
        for block in re.findall(r"^```sh\n(.*?)^```$", section, re.DOTALL | re.MULTILINE):
            for line in block.splitlines():
                yield section.partition("\n")[0], line


class Reader:
    """The page's reader, who has all its machines in one directory."""

    def __init__(self, folder: Path) -> None:
        self.log: list[str] = []
        self._folder = folder
        self._gateway = free_port()
        self._ports = {name: free_port() for name in ("127.0.0.1", "router-a", "router-b", "cloud", "site")}
        self._env = {
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "RUST_LOG": "info",
            "ROS_DOMAIN_ID": str(1 + (os.getpid() + 50) % 100),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        self._running: dict[str, asyncio.subprocess.Process] = {}
        self._reading: list[asyncio.Task[None]] = []
        for path in filter(Path.is_file, (ROOT / "config").rglob("*.*")):
            copy = folder / path.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_text(self._config(path), encoding="utf-8")

    def _config(self, path: Path) -> str:
        """A shipped file with other ports, and nothing open to the network."""
        text = self.here(path.read_text(encoding="utf-8"))
        text = text.replace("tcp/[::]:7447", f"tcp/127.0.0.1:{self._ports.get(path.stem, 0)}")
        text = text.replace('host = "0.0.0.0"', f'host = "127.0.0.1"\nport = {self._gateway}')
        for name, address in (("cloud", "cloud.example.org"), ("site", "192.168.1.10")):
            listen = f'addresses: [127.0.0.1], listen: ["tls/127.0.0.1:{self._ports[name]}"]'
            text = text.replace(f"addresses: [{address}]", listen)
        return text

    def here(self, text: str) -> str:
        """The text with this test's ports and places."""
        for name in ("127.0.0.1", "router-a", "router-b"):
            text = text.replace(f"tcp/{name}:7447", f"tcp/127.0.0.1:{self._ports[name]}")
        return text.replace("127.0.0.1:7000", f"127.0.0.1:{self._gateway}").replace(
            "/etc/macs", f"{self._folder}/etc/macs"
        )

    async def run(self, line: str) -> str:
        """Type one command: to its end, or until it is ready if it stays. What it printed."""
        if line.startswith(CTRL_C):
            await self.stop(line.removeprefix(CTRL_C))
            return ""
        program, *argv = shlex.split(self.here(line), comments=True)
        if program in ("scp", "cp"):
            return self._copy([word for word in argv if not word.startswith("-")])
        if program == "zenohd" and zenohd() is None:
            program, argv = "macs", ["router", *argv]
        command = {"macs": [sys.executable, "-m", "bridge"], "python": [sys.executable], "zenohd": [str(zenohd())]}
        pipe = asyncio.subprocess.PIPE
        process = await asyncio.create_subprocess_exec(
            *command[program], *argv, cwd=self._folder, env=self._env, stdout=pipe, stderr=pipe, limit=LINE_BYTES
        )
        if not line.startswith(STAYS):
            out, errors = await asyncio.wait_for(process.communicate(), 90)
            # the doctor's 1 is a warning, as of a busy machine
            allowed = (0, 1) if "doctor" in argv else (0,)
            assert process.returncode in allowed, f"{line}\n{out.decode()}\n{errors.decode()}\n" + "\n".join(self.log)
            return out.decode()
        self._running[line] = process
        seen = len(self.log)
        self._reading += [asyncio.create_task(self._keep(stream)) for stream in (process.stdout, process.stderr)]
        ready = asyncio.create_task(self._ready(READY[program], seen))
        await asyncio.wait([ready, asyncio.create_task(process.wait())], timeout=30, return_when="FIRST_COMPLETED")
        assert ready.done(), f"{line}\n" + "\n".join(self.log[seen:])
        return ""

    async def _ready(self, said: str, seen: int) -> None:
        while not any(said in text for text in self.log[seen:]):
            await asyncio.sleep(0.01)

    async def sees_a_robot(self) -> None:
        """Wait until a headset would see a robot: a person at a terminal is slower than any router."""
        async with await Headset.connect("127.0.0.1", self._gateway) as headset:
            while not (await headset.online()).ros_agent_ids:
                await asyncio.sleep(0.05)

    def _copy(self, words: list[str]) -> str:
        *sources, target = words
        into = self._folder / target.rpartition(":")[2]
        if into == self._folder / "policy.yaml":
            shutil.copy(self._folder / sources[0], into)
            return ""
        into.mkdir(parents=True, exist_ok=True)
        for source in (self._folder / name for name in sources):
            if source.is_dir():
                shutil.copytree(source, into / source.name)
            else:
                shutil.copy(source, into)
        return ""

    async def _keep(self, stream: asyncio.StreamReader | None) -> None:
        assert stream is not None
        while text := await stream.readline():
            self.log.append(text.decode(errors="replace").rstrip())

    async def stop(self, where: str = "", *, but: str = "no such window") -> None:
        """Ctrl-C in every window, in those of one machine, in all but one."""
        for line in [line for line in reversed(self._running) if where in line and but not in line]:
            process = self._running.pop(line)
            if process.returncode is None:
                process.terminate()
            await asyncio.wait_for(process.wait(), PATIENCE_S)


@pytest.mark.timeout(300)
async def test_the_page_from_top_to_bottom(tmp_path: Path) -> None:
    """Every command does what the page says: three deployments come up, and in each a headset reads and drives the
    robot; the rules of the one across networks are proven."""
    somebody = Reader(tmp_path)
    read_from, drove = [], 0
    before = ""
    try:
        for section, line in commands():
            if section != before and section in ANEW:
                await somebody.stop(but="bridge.ros.demo")
            before = section
            if line.startswith("macs headset"):
                await asyncio.wait_for(somebody.sees_a_robot(), PATIENCE_S)
            out = await somebody.run(line)
            if " sub " in line:
                messages = [json.loads(text) for text in out.splitlines()]
                read_from.append(messages[-1]["from"])
            if " pub " in line:
                drove += 1
                at = await somebody.run("macs headset 127.0.0.1:7000 sub /pose geometry_msgs/PoseStamped --count 1")
                assert json.loads(at)["message"]["pose"]["position"]["x"] > 0.1 * drove
            if line.startswith("macs ls"):
                assert re.search(r"^ros +7\b", out, re.MULTILINE), out
    finally:
        await somebody.stop()
    assert (read_from, drove) == ([1, 7, 7, 7, 7], 2)
    assert not [line for line in somebody.log if "Traceback" in line]


def test_the_page_names_what_exists() -> None:
    """Each file, unit and verb in a command that is not run, and in the text, is there."""
    for path in re.findall(r"\bconfig/[\w./-]+", PAGE):
        assert (ROOT / path.rstrip(".")).exists(), path
    for name in re.findall(r"\bmacs-(?!zenoh\b)[a-z]+\b", PAGE):
        assert (ROOT / "config" / "systemd" / f"{name}.service").exists(), name
