"""`macs up --demo`: what a newcomer runs first, as a whole."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import sys
from collections.abc import Coroutine
from typing import Any

import pytest
from geometry_msgs.msg import Twist

import macs_zenoh
from tests.support.programs import ROOT, free_port
from tests.support.ros_peer import Peer
from tests.support.waiting import PATIENCE_S

PATIENT = "import sys; from bridge.cli import main, up; up.READY_S = 80.0; sys.exit(main())"
"""`macs` on a machine that is busy."""


def demo(*argv: str, env: dict[str, str]) -> Coroutine[Any, Any, asyncio.subprocess.Process]:
    return asyncio.create_subprocess_exec(
        *(sys.executable, "-c", PATIENT, "up", "--demo", "--once", *argv),
        cwd=ROOT,
        env={**os.environ, **env},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )


async def test_the_demo_leaves_a_robot_in_the_users_domain_alone(domain: int, peer: Peer) -> None:
    """Whatever domain the environment names, nobody there hears of the demo; the demo's own is printed."""
    driven = await peer.subscription(Twist, "/cmd_vel")
    process = await demo("--port", "0", "--router-port", "0", env={"ROS_DOMAIN_ID": str(domain)})
    out, log = await asyncio.wait_for(process.communicate(), 90)
    assert process.returncode == 0, out.decode() + log.decode()
    (own,) = re.findall(r"alone: ROS domain (\d+), on this machine only; mesh 'demo'", out.decode())
    assert int(own) != domain
    assert driven.empty()


async def test_the_demo_drives_no_robot_that_waited_for_its_router(domain: int) -> None:
    """A robot with the demo robot's id, whose agent waits for a router where the demo starts one, gets nothing."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    port = endpoint.rpartition(":")[2]

    async def wait_for_router(heard: list[bytes]) -> None:
        async with macs_zenoh.join("ros", id=1, connect=[endpoint]) as robot:
            heard.append(b"joined")
            async for message in robot:
                heard.append(message.data)

    heard: list[bytes] = []
    robot = asyncio.create_task(wait_for_router(heard))
    process = await demo("--port", "0", "--router-port", port, env={"ROS_DOMAIN_ID": str(domain)})
    out, log = await asyncio.wait_for(process.communicate(), 90)
    robot.cancel()
    assert process.returncode == 0, out.decode() + log.decode()
    assert heard == [b"joined"]


async def test_two_demos_at_once(domain: int) -> None:
    """Two demos with the usual ports, started in one moment, are two shows in two domains."""
    both = await asyncio.gather(*(demo(env={"ROS_DOMAIN_ID": str(domain)}) for _ in range(2)))
    shown = await asyncio.wait_for(asyncio.gather(*(process.communicate() for process in both)), 120)
    text = [(out + log).decode() for out, log in shown]
    assert [process.returncode for process in both] == [0, 0], text
    domains = [re.findall(r"ROS domain (\d+)", out)[0] for out in text]
    assert domains[0] != domains[1]


async def test_the_demo_shows_a_headset_that_sees_and_drives_a_robot(domain: int) -> None:
    """With one command and no hardware, a headset gets pictures and poses of a robot and moves it."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "bridge", "up", "--demo", "--once", "--port", "0", "--router-port", "0"),
        cwd=ROOT,
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    out, log = await asyncio.wait_for(process.communicate(), 60)
    shown = out.decode()
    assert process.returncode == 0, shown + log.decode()
    for step in ("connected", "who is here", "camera", "pose", "drive"):
        assert f"\n  {step} " in shown
    assert "FAILED" not in shown


@pytest.mark.soak
@pytest.mark.parametrize("moments", [range(1, 14), range(14, 27), range(27, 40)], ids=["early", "starting", "shown"])
async def test_it_ends_whenever_it_is_told_to(domain: int, moments: range) -> None:
    """SIGTERM at every tenth of a second of its start and show: it ends, with 0, without a traceback, and so have its
    programs, which its output's end tells."""
    for tenth in moments:
        argv = [sys.executable, "-m", "bridge", "up", "--demo", "--port", "0", "--router-port", "0"]
        process = await asyncio.create_subprocess_exec(
            *argv,
            cwd=ROOT,
            env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        reading = asyncio.create_task(process.communicate())
        await asyncio.sleep(tenth / 10)
        process.send_signal(signal.SIGTERM)
        try:
            text = (await asyncio.wait_for(reading, PATIENCE_S))[0].decode()
        except asyncio.TimeoutError:
            process.kill()
            raise AssertionError(f"told after {tenth / 10} s, it did not end") from None
        # before Python has come to where it takes signals, they end it as they end any program
        assert process.returncode == 0 or (process.returncode == -signal.SIGTERM and not text), text
        assert "Traceback" not in text, f"told after {tenth / 10} s: {text}"
