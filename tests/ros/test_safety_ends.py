"""However a robot agent ends, as far as a process can notice it: the stop message is the last on its topic."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from macs_zenoh import join
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh.panics import PANICKED
from tests.panicking import panicking
from tests.ros.driven import STOPPED, Heard, driving, hear, may_command, site
from tests.support.programs import ROOT, Program, free_port
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S, until

LONG = """
[[robot.rules]]
match = "/cmd_vel"
deadman_s = 60
deadman_message = { linear = { z = -1 } }
"""
"""The dead-man itself comes too late to help."""

NOTICED = [
    signal.SIGHUP,
    signal.SIGQUIT,
    signal.SIGTERM,
    signal.SIGINT,
    signal.SIGUSR1,
    signal.SIGALRM,
    signal.SIGXCPU,
]


async def moves(heard: Heard) -> None:
    await until(lambda: heard.values and heard.last == 0.5)


@pytest.mark.parametrize("number", NOTICED, ids=lambda number: number.name)
async def test_a_signal_stops_the_robot(domain: int, peer: Peer, tmp_path: Path, number: signal.Signals) -> None:
    """Commands flow, and a signal ends the agent: the stop message is the last. The exit is clean."""
    heard = await hear(peer)
    async with site(domain, tmp_path, LONG) as place, place.robot() as robot, place.headset() as driver:
        await may_command(driver, 1)
        async with driving(driver, 1):
            await moves(heard)
            assert await robot.stop(number) == 0
            await until(lambda: heard.last == STOPPED)
            await asyncio.sleep(0.3)
            assert heard.last == STOPPED


@pytest.mark.parametrize("where", ["call", "callback", "hidden"])
async def test_a_panic_of_zenoh_stops_the_robot(domain: int, peer: Peer, tmp_path: Path, where: str) -> None:
    """Commands flow, and the agent's Zenoh panics, wherever: the agent ends by itself, and the stop message is the
    last on the topic, though nothing of Zenoh can be relied on any more."""
    heard, now = await hear(peer), tmp_path / "now"
    async with (
        site(domain, tmp_path, LONG) as place,
        place.headset() as driver,
        place.robot(env=panicking(where, now)) as robot,
    ):
        await may_command(driver, 1)
        async with driving(driver, 1):
            await moves(heard)
            now.touch()
            assert await asyncio.wait_for(robot.wait(), 40) == PANICKED
            await until(lambda: heard.last == STOPPED)
            await asyncio.sleep(0.3)
            assert heard.last == STOPPED


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGQUIT, signal.SIGKILL], ids=lambda number: number.name)
async def test_the_end_of_its_supervisor_stops_the_robot(
    domain: int, peer: Peer, tmp_path: Path, number: signal.Signals
) -> None:
    """The same when `macs up` ends that runs it, also by kill -9."""
    heard = await hear(peer)
    settings = tmp_path / "macs.toml"
    settings.write_text(LONG)
    port = free_port()
    argv = ("up", "--settings", str(settings), "--port", "0", "--router-port", str(port))
    process = await _up(argv, domain)
    try:
        mesh = MeshSettings(connect=[f"tcp/127.0.0.1:{port}"])
        async with join("unity", id=300, settings=mesh) as driver:
            await may_command(driver, 1)
            async with driving(driver, 1):
                await moves(heard)
                process.send_signal(number)
                await until(lambda: heard.last == STOPPED)
                await asyncio.sleep(0.3)
                assert heard.last == STOPPED
    finally:
        if process.returncode is None:
            process.terminate()
        await asyncio.wait_for(process.wait(), PATIENCE_S)


async def _up(argv: Sequence[str], domain: int) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "bridge",
        *argv,
        cwd=ROOT,
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )


async def test_nohup_keeps_a_robot_alive(domain: int, tmp_path: Path) -> None:
    """A hang-up that was ignored when the program started ends nothing, as `nohup` promises."""
    async with site(domain, tmp_path, LONG) as place:
        robot = Program(
            "agent", "--id", "1", "-e", place.router.endpoint, env={"ROS_DOMAIN_ID": str(domain)}, within=["nohup"]
        )
        async with robot, place.headset() as driver:
            robot.send_signal(signal.SIGHUP)
            await until(lambda: (1, 1) in driver.directory)
            await driver.call("ros", 1, "status")
