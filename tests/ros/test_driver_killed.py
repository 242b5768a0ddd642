"""A headset that tells when it made its commands drives a robot, and a program on the way dies or hangs: the robot
stops within its dead-man and 100 ms, and what waited meanwhile is not carried out."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
import time
from contextlib import AsyncExitStack, suppress
from pathlib import Path

import pytest

from tests.ros.driven import SETTINGS, STOPPED, Heard, hear
from tests.support.delays import Delays
from tests.support.processes import ROOT
from tests.support.programs import Program, free_port
from tests.support.ros_peer import Peer
from tests.support.waiting import until

DEADMAN_S = 0.5
MARGIN_S = 0.1
HZ = 20
HANGS_S = 1.5


async def _drive(stack: AsyncExitStack, port: int) -> asyncio.subprocess.Process:
    """A headset in a process of its own; the speed is the number of the command."""
    command = ("pub", "/cmd_vel", "geometry_msgs/Twist", '{"linear": {"x": $i}}', "--agents", "1")
    how = ("--timed", "--rate", str(HZ), "--count", "100000")
    program = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "bridge", "headset", f"127.0.0.1:{port}", *command, *how),
        cwd=ROOT,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )

    async def end() -> None:
        with suppress(ProcessLookupError):
            program.kill()
        await program.wait()

    stack.push_async_callback(end)
    return program


async def _stop_of(heard: Heard, since: float) -> float:
    """When the stop message came."""
    await until(lambda: STOPPED in heard.since(since))
    return next(at for at, value in heard.values if at > since and value == STOPPED)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
@pytest.mark.parametrize("victim", ["headset", "gateway", "router"])
async def test_the_robot_stops(victim: str, number: signal.Signals, domain: int, peer: Peer, tmp_path: Path) -> None:
    """Whichever of them it is. One that hung and goes on does not bring what it held."""
    settings = tmp_path / "macs.toml"
    settings.write_text(SETTINGS.format(deadman_s=DEADMAN_S))
    heard = await hear(peer)
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        router = Program("router", "-l", endpoint)
        gateway = Program("gateway", "--port", "0", "-e", endpoint)
        for program in (router, gateway):
            await program.start()
            stack.push_async_callback(program.stop, signal.SIGKILL)
        robot = Program(
            "agent", "--id", "1", "-e", endpoint, "--settings", str(settings), env={"ROS_DOMAIN_ID": str(domain)}
        )
        await stack.enter_async_context(robot)
        driver = await _drive(stack, gateway.port)
        await until(lambda: len(heard.values) > HZ)
        with Delays() as delays:
            delays.s()
            pid = {"headset": driver.pid, "gateway": gateway.pid, "router": router.pid}[victim]
            began = time.monotonic()
            os.kill(pid, number)
            stopped = await _stop_of(heard, began)
            assert stopped - began < DEADMAN_S + MARGIN_S + delays.s()
        if number == signal.SIGSTOP:
            await _goes_on(victim, pid, heard, stopped)


async def _goes_on(victim: str, pid: int, heard: Heard, stopped: float) -> None:
    """The robot is driven again, by what is said then."""
    last = max(value for at, value in heard.values if at < stopped)
    await asyncio.sleep(HANGS_S)  # so much waits for who hangs
    assert not [value for value in heard.since(stopped) if value != STOPPED]
    os.kill(pid, signal.SIGCONT)
    await until(lambda: [value for value in heard.since(stopped) if value > last])
    if victim != "headset":  # what that says then is what it makes then
        first = next(value for value in heard.since(stopped) if value > last)
        assert first - last > HZ * HANGS_S / 2, "commands that had waited were carried out"
