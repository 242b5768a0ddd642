"""docs/agents.md and examples/follow_robot.py: the programs run as they stand there, with the demo robot."""

from __future__ import annotations

import asyncio
import os
import re
import sys
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

import macs_zenoh
from tests.support.processes import finished
from tests.support.programs import ROOT, Program, free_port

PAGE = (ROOT / "docs" / "agents.md").read_text(encoding="utf-8")
EXAMPLE = (ROOT / "examples" / "follow_robot.py").read_text(encoding="utf-8")
ROUTER = "tcp/127.0.0.1:7447"


@pytest.fixture
async def robot(domain: int) -> AsyncIterator[None]:
    """The demo robot's ROS node."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "bridge.ros.demo", cwd=ROOT, env={**os.environ, "ROS_DOMAIN_ID": str(domain)}
    )
    try:
        yield
    finally:
        process.terminate()
        await process.wait()


async def printed(program: str, folder: Path) -> str:
    """What a program says until it ends."""
    path = folder / "program.py"
    path.write_text(program)
    code, out, errors = await finished(sys.executable, str(path), env={"PYTHONPATH": str(ROOT)})
    assert code == 0, errors
    return out


async def ready(endpoint: str, namespace: str | None = None) -> None:
    """Wait until the robot tells of its node's topics and service."""
    settings = macs_zenoh.MeshSettings(connect=[endpoint], namespace=namespace)
    async with macs_zenoh.join("unity", settings=settings) as agent:
        for _ in range(100):
            try:
                offered = await agent.call("ros", 1, "offers")
                if all(name in offered for name in (b'"/pose"', b'"/cmd_vel"', b'"/set_lights"')):
                    return
            except macs_zenoh.Unreachable:
                pass
            await asyncio.sleep(0.2)
    raise AssertionError("the robot does not tell of its topics")


async def test_the_page(robot: None, domain: int, tmp_path: Path) -> None:
    """The program on the page drives the robot and prints what the page says."""
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    (said,) = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with (
        Program("router", "-l", endpoint),
        Program("agent", "--id", "1", "-e", endpoint, env={"ROS_DOMAIN_ID": str(domain)}),
    ):
        await ready(endpoint)
        assert await printed(program.replace(ROUTER, endpoint), tmp_path) == said


async def test_the_example(robot: None, domain: int, tmp_path: Path) -> None:
    """So does the example, in the demo's namespace; it has at most 15 lines of code in its function."""
    body = EXAMPLE.partition("async def main")[2].partition("asyncio.run")[0].splitlines()[1:]
    assert len([line for line in body if line.strip()]) <= 15
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    namespace = ("--namespace", "demo")
    async with (
        Program("router", "-l", endpoint, *namespace),
        Program("agent", "--id", "1", "-e", endpoint, *namespace, env={"ROS_DOMAIN_ID": str(domain)}),
    ):
        await ready(endpoint, "demo")
        said = await printed(EXAMPLE.replace(ROUTER, endpoint), tmp_path)
        assert re.fullmatch(r"lights: .+\nrobot 1 has come 0\.[5-9] m\n", said), said
