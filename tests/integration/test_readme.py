"""The README's Python runs as it stands there, against a real router."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import sys
from pathlib import Path

import pytest

import macs_zenoh
from tests.support.programs import ROOT, Program, free_port
from tests.support.waiting import PATIENCE_S

README = (ROOT / "README.md").read_text(encoding="utf-8")
LOCAL_ROUTER = "tcp/127.0.0.1:7447"


def the_example() -> str:
    """The one Python program on the page."""
    (block,) = re.findall(r"^```python\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)
    return str(block)


def test_the_example_is_short() -> None:
    """It has at most 15 lines of code, and connects where the page says a router is."""
    assert len([line for line in the_example().splitlines() if line]) <= 15
    assert LOCAL_ROUTER in the_example()


def test_the_page_links_to_files_that_exist() -> None:
    """No link of the README points at nothing."""
    targets = [link.partition("#")[0] for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    assert targets
    assert [target for target in targets if not (ROOT / target).exists()] == []


async def test_the_example_runs(tmp_path: Path) -> None:
    """The example says that it is there, answers a call, prints what it gets, answers it, and stops on Ctrl-C."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    program = tmp_path / "example.py"
    program.write_text(the_example().replace(LOCAL_ROUTER, endpoint))
    async with (
        Program("router", "-l", endpoint),
        macs_zenoh.join("unity", id=300, connect=[endpoint]) as headset,
    ):
        process = await started(program)
        assert process.stdout is not None
        hello = await asyncio.wait_for(headset.receive(), PATIENCE_S)
        assert (hello.sender_type, hello.sender_id, hello.data) == ("ros", 7, b"robot 7 is here")

        assert await headset.call("ros", 7, "battery") == b"87 %"
        for text, ids, groups in (("by id", [7], []), ("by group", [], [3])):
            headset.send(text.encode(), to="ros", ids=ids, groups=groups)
            assert (await asyncio.wait_for(headset.receive(), PATIENCE_S)).data == b"got it"
            assert (await asyncio.wait_for(process.stdout.readline(), PATIENCE_S)).decode() == f"unity 300 b'{text}'\n"

        assert await interrupted(process) == ""
        assert [agent.id for agent in headset.online()] == [300] or await left(headset)


async def test_the_example_misses_its_router(tmp_path: Path) -> None:
    """Without a router the example says so, waits, and ends on Ctrl-C without a traceback."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    program = tmp_path / "example.py"
    program.write_text(the_example().replace(LOCAL_ROUTER, endpoint))
    process = await started(program)
    assert process.stderr is not None
    said = (await asyncio.wait_for(process.stderr.readline(), PATIENCE_S)).decode()
    assert said == f"no router at {endpoint} yet; waiting for it\n"
    assert await interrupted(process) == ""


async def test_text_is_no_data(router: str) -> None:
    """Who sends a text is told to encode it."""
    async with macs_zenoh.join("unity", id=300, connect=[router]) as agent:
        with pytest.raises(macs_zenoh.MacsError, match=r"bytes, not text.*encode"):
            agent.broadcast("hello")  # type: ignore[arg-type]


async def started(program: Path) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable,
        str(program),
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


async def interrupted(process: asyncio.subprocess.Process) -> str:
    """What a program says on stderr when Ctrl-C ends it."""
    process.send_signal(signal.SIGINT)
    assert process.stderr is not None
    errors = await asyncio.wait_for(process.stderr.read(), PATIENCE_S)
    assert await asyncio.wait_for(process.wait(), PATIENCE_S) == 0
    return errors.decode()


async def left(headset: macs_zenoh.Agent) -> bool:
    """Wait until robot 7 has left."""
    gone = asyncio.Event()
    headset.on_presence(lambda agent, online: gone.set() if agent.id == 7 and not online else None)
    return await asyncio.wait_for(gone.wait(), PATIENCE_S)
