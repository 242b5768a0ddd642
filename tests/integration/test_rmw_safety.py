"""Robots that run rmw_zenoh: dead-man, emergency stop, and what becomes of them when something is killed."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any, NamedTuple

import pytest

import macs_zenoh
from macs_zenoh import ros
from macs_zenoh.agent import Agent
from tests.support.programs import Program, ended
from tests.support.routers import Router
from tests.support.waiting import PATIENCE_S, until

pytest.importorskip("xxhash", reason="being a ROS node needs xxhash: pip install 'macs-zenoh[rmw-zenoh]'")
pytestmark = pytest.mark.timeout(300)

SETTINGS = """
[[rmw_zenoh.robots]]
id = 7
node_namespace = "/robot7"

[[robot.rules]]
match = "/robot7/cmd_vel"
exclusive = true
deadman_s = 0.4
deadman_message = {}
"""
TWIST = "geometry_msgs/Twist"
TOPIC = "/robot7/cmd_vel"


class Site(NamedTuple):
    """A router, `macs rmw-zenoh`, a node of the robot's, and what it was commanded; an agent that drives."""

    router: Router
    program: Program
    node: ros.Node
    speeds: list[float]
    agent: Agent

    async def there(self) -> None:
        """Wait until robot 7 is online."""
        await until(lambda: self.agent.directory.ids(1) == [7], PATIENCE_S)

    async def driven(self, drive: Any, speed: float) -> None:
        """Command a speed until the robot has it."""

        def command() -> bool:
            drive.publish({"linear": {"x": speed}})
            return self.speeds[-1:] == [speed]

        await until(command, PATIENCE_S, every_s=0.05)


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[Site]:
    settings = tmp_path / "robots.toml"
    settings.write_text(SETTINGS, encoding="utf-8")
    async with AsyncExitStack() as stack:
        router = await stack.enter_async_context(Router())
        arguments = ("rmw-zenoh", "--settings", str(settings), "-e", router.endpoint)
        program = await stack.enter_async_context(Program(*arguments))
        node = await stack.enter_async_context(ros.node("base", namespace="/robot7", connect=[router.endpoint]))
        agent = await stack.enter_async_context(macs_zenoh.join("unity", id=300, connect=[router.endpoint]))
        speeds: list[float] = []
        commands = node.subscribe("cmd_vel", TWIST)

        async def obey() -> None:
            async for message in commands:
                speeds.append(message.value["linear"]["x"])

        obeying = asyncio.create_task(obey())
        stack.callback(obeying.cancel)
        yield Site(router, program, node, speeds, agent)


async def test_silence_stops_the_robot_once(site: Site) -> None:
    """When commands cease the dead-man's message comes, one; commands may begin again after it."""
    await site.there()
    drive = await site.agent.advertise(TOPIC, robot=7)
    await site.driven(drive, 0.5)
    await until(lambda: site.speeds[-1] == 0.0, PATIENCE_S)
    await site.driven(drive, 0.25)
    assert site.speeds.count(0.0) == 1
    drive.close()
    await until(lambda: site.speeds[-1] == 0.0, PATIENCE_S)


async def test_a_stop_holds(site: Site) -> None:
    """The emergency stop has the robot stop, refuses commands, and holds although all its nodes come and go."""
    await site.there()
    drive = await site.agent.advertise(TOPIC, robot=7)
    refused: list[str] = []
    drive.on_refused(lambda robot, reason: refused.append(reason))
    await site.driven(drive, 0.5)
    code, _, errors = await ended("stop", "7", "-e", site.router.endpoint)
    assert code == 0, errors
    await until(lambda: site.speeds[-1] == 0.0, PATIENCE_S)

    def refuses() -> bool:
        drive.publish({"linear": {"x": 0.75}})
        return any("stop holds" in reason for reason in refused)

    await until(refuses, PATIENCE_S, every_s=0.05)
    site.node.close()
    await until(lambda: site.agent.directory.ids(1) == [], PATIENCE_S)
    async with ros.node("again", namespace="/robot7", connect=[site.router.endpoint]) as node:
        commands = node.subscribe("cmd_vel", TWIST)
        await site.there()
        refused.clear()
        await until(refuses, PATIENCE_S, every_s=0.05)
        code, _, errors = await ended("stop", "7", "--release", "-e", site.router.endpoint)
        assert code == 0, errors

        speeds: list[float] = []

        async def obey() -> None:
            async for message in commands:
                speeds.append(message.value["linear"]["x"])

        obeying = asyncio.create_task(obey())

        def obeys() -> bool:
            drive.publish({"linear": {"x": 1.0}})
            return 1.0 in speeds

        await until(obeys, PATIENCE_S, every_s=0.05)
        obeying.cancel()
        assert 0.75 not in speeds
    assert 0.75 not in site.speeds


async def test_whatever_is_killed_registrations_come_back(site: Site) -> None:
    """After the program was killed, and after the router was, an agent drives the robot without doing anything."""
    await site.there()
    drive = await site.agent.advertise(TOPIC, robot=7)
    await site.driven(drive, 0.5)
    await site.program.stop(signal.SIGKILL)
    await until(lambda: site.agent.directory.ids(1) == [], PATIENCE_S)
    await site.program.start()
    await site.there()
    await site.driven(drive, 0.25)
    await site.router.stop(signal.SIGKILL)
    await site.router.start()
    await site.there()
    await site.driven(drive, 0.125)


async def test_a_stop_that_the_robot_could_not_hear(site: Site) -> None:
    """When the router goes the robot may be moving: it gets the dead-man's message once it can be reached again."""
    await site.there()
    drive = await site.agent.advertise(TOPIC, robot=7)
    await site.driven(drive, 0.5)
    await site.router.stop(signal.SIGKILL)
    await until(lambda: any("out of sight" in line for line in site.program.log), PATIENCE_S)
    assert site.speeds[-1] == 0.5
    await site.router.start()
    await until(lambda: site.speeds[-1] == 0.0, PATIENCE_S)
    await site.there()
    await site.driven(drive, 0.25)
    assert site.speeds.count(0.0) == 1
