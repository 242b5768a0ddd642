"""A panic of Zenoh, a real one, ends the program at once and loudly: none is left half alive."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import sys
from collections.abc import AsyncIterator
from contextlib import suppress

import pytest

from tests.panicking import panicking
from tests.support.programs import ROOT, Program, free_port
from tests.support.waiting import until

PANICKED = 70


@pytest.fixture
async def endpoint() -> AsyncIterator[str]:
    """A router as a process."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with Program("router", "-l", endpoint):
        yield endpoint


@pytest.mark.parametrize("where", ["call", "callback", "hidden"])
async def test_a_gateway_ends(endpoint: str, where: str) -> None:
    """Wherever Zenoh panics in a gateway, it ends within seconds, with an exit code of its own and a line that says
    why."""
    async with Program("gateway", "--port", "0", "-e", endpoint, env=panicking(where)) as gateway:
        assert await asyncio.wait_for(gateway.wait(), 40) == PANICKED
    await until(lambda: any("Zenoh has panicked" in line for line in gateway.log))


async def test_a_router_ends(endpoint: str) -> None:
    """A router whose Zenoh panics towards another one ends as well."""
    listen = f"tcp/127.0.0.1:{free_port()}"
    async with Program("router", "-l", listen, "-e", endpoint, env=panicking("hidden")) as router:
        assert await asyncio.wait_for(router.wait(), 40) == PANICKED
    await until(lambda: any("Zenoh has panicked" in line for line in router.log))


async def test_up_starts_again_what_panicked(endpoint: str) -> None:
    """`macs up` sees the end of each program that has panicked, gateway and robot, and starts it again."""
    environment = {**os.environ, **panicking("call")}
    command = [sys.executable, "-m", "bridge", "up", "--port", "0", "-e", endpoint]
    up = await asyncio.create_subprocess_exec(*command, cwd=ROOT, env=environment, stderr=asyncio.subprocess.PIPE)
    assert up.stderr is not None
    ends = set()
    robots = importlib.util.find_spec("rclpy") is not None
    try:
        while len(ends) < 1 + robots:
            line = (await asyncio.wait_for(up.stderr.readline(), 60)).decode()
            assert line, "macs up has ended"
            if f"ended with exit code {PANICKED}, starts again" in line:
                ends.add("gateway" in line)
    finally:
        with suppress(ProcessLookupError):
            up.terminate()
        await up.communicate()
