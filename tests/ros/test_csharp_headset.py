"""The C# headset of examples/unity, compiled and run: all four kinds of nodes with a real gateway, robot and ROS."""

from __future__ import annotations

import asyncio
import shutil
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from std_msgs.msg import String
from std_srvs.srv import SetBool

from tests.support.once import made_once
from tests.support.programs import ROOT, Program, free_port
from tests.support.ros_peer import Peer, say_hello, set_bool
from tests.support.waiting import PATIENCE_S, get

SOURCE = ROOT / "examples" / "unity" / "MacsHeadset.cs"

pytestmark = pytest.mark.skipif(
    not (shutil.which("mcs") and shutil.which("mono")),
    reason="needs a C# compiler and runtime: sudo apt install mono-mcs libmono-system-runtime-serialization4.0-cil",
)


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program, compiled without a warning by the command that the file names."""

    def make(folder: Path) -> None:
        out = f"-out:{folder / 'MacsHeadset.exe'}"
        command = ["mcs", "-warnaserror", "-r:System.Runtime.Serialization", out, str(SOURCE)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr

    return made_once(tmp_path_factory, "csharp", make) / "MacsHeadset.exe"


class CSharp:
    """The program while it runs, and what it has said so far."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process
        self.said: list[str] = []

    async def says(self, beginning: str) -> str:
        """The next line that begins like this."""
        assert self._process.stdout is not None
        while line := (await asyncio.wait_for(self._process.stdout.readline(), PATIENCE_S)).decode().rstrip():
            self.said.append(line)
            if line.startswith(beginning):
                return line
        raise AssertionError(f"it never said {beginning!r}, but {self.said}")


@asynccontextmanager
async def running(program: Path, port: int) -> AsyncIterator[CSharp]:
    """The program, connected to a gateway of this machine."""
    process = await asyncio.create_subprocess_exec(
        "mono", str(program), "127.0.0.1", str(port), "120", stdout=asyncio.subprocess.PIPE
    )
    try:
        yield CSharp(process)
    finally:
        process.kill()
        await process.wait()


async def test_the_four_kinds_of_nodes(compiled: Path, domain: int, peer: Peer) -> None:
    """It receives a topic, sends to one, calls a service, answers calls, hears of a refusal, and does all of it again
    after the gateway was gone."""
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", str(free_port())
    gateway = ("gateway", "--port", port, "-e", endpoint)
    agent = Program("agent", "--id", "1", "-e", endpoint, env={"ROS_DOMAIN_ID": str(domain)})
    chatter = await peer.publisher(String, "/chatter")
    talk = await peer.subscription(String, "/talk")
    await peer.session.run(lambda: peer.session.node.create_service(SetBool, "/set", set_bool))
    asking = await peer.session.run(lambda: peer.session.node.create_client(SetBool, "/ask"))
    talking = asyncio.create_task(say_hello(peer, chatter))
    try:
        async with Program("router", "-l", endpoint), agent, running(compiled, int(port)) as headset:
            for _ in range(2):
                async with Program(*gateway):
                    await headset.says("connected as headset ")
                    assert "no_such_msgs" in await headset.says("robot 1 refused /nothing: ")
                    await _all_four(headset, talk, peer, asking)
                while not talk.empty():
                    talk.get_nowait()
                await headset.says("disconnected: ")
    finally:
        talking.cancel()


async def _all_four(headset: CSharp, talk: asyncio.Queue[String], peer: Peer, asking: object) -> None:
    assert await headset.says("/chatter of robot 1: ") == "/chatter of robot 1: hello from ROS"
    assert (await get(talk)).data == "hello from C#"
    assert await headset.says("/set: True") == "/set: True set to True"
    assert await peer.session.run(lambda: asking.wait_for_service(PATIENCE_S))  # type: ignore[attr-defined]
    loop = asyncio.get_running_loop()
    answered: asyncio.Future[SetBool.Response] = loop.create_future()
    call = await peer.session.run(lambda: asking.call_async(SetBool.Request(data=True)))  # type: ignore[attr-defined]
    call.add_done_callback(lambda done: loop.call_soon_threadsafe(answered.set_result, done.result()))
    response = await asyncio.wait_for(answered, PATIENCE_S)
    assert (response.success, response.message) == (True, "headset says True")
