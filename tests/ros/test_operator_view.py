"""What an operator sees of a real robot that a headset drives, and how it is stopped from a command line."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from bridge.headset.client import Headset
from bridge.headset.nodes import Publisher
from tests.support.programs import Program, ended, free_port, macs
from tests.support.ros_peer import Peer
from tests.support.waiting import get

SETTINGS = """
[robot]
id = 7
group = 3
stop_allow = ["unity", "operator/5"]
release_allow = ["operator/5"]

[[robot.rules]]
match = "/cmd_vel"
exclusive = true
hold_s = 60
deadman_s = 60
deadman_message = { linear = { z = -1 } }
"""


@dataclass
class Site:
    """A headset that drives robot 7, and what arrives on the robot's topic."""

    endpoint: str
    headset: Headset
    commands: Publisher
    driven: asyncio.Queue[Any]

    async def drive(self, x: float) -> None:
        twist = Twist()
        twist.linear.x = x
        await self.commands.publish(bytes(serialize_message(twist)))

    async def robot(self, *options: str) -> Any:
        """Robot 7's row of `macs ls --json`."""
        (row,) = [row for row in await macs("ls", "--json", "-e", self.endpoint, *options) if row["type"] == "ros"]
        return row

    async def until(self, holds: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """The robot's state once something holds."""
        for _ in range(20):
            status: dict[str, Any] = (await self.robot())["status"]
            if holds(status):
                return status
        raise AssertionError(status)


@pytest.fixture
async def site(domain: int, peer: Peer, tmp_path: Path) -> AsyncIterator[Site]:
    settings = tmp_path / "macs.toml"
    settings.write_text(SETTINGS)
    driven = await peer.subscription(Twist, "/cmd_vel")
    await peer.publisher(String, "/chatter")
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        await stack.enter_async_context(Program("router", "-l", endpoint))
        gateway = await stack.enter_async_context(Program("gateway", "--port", "0", "-e", endpoint))
        robot = Program("agent", "--settings", str(settings), "-e", endpoint, env={"ROS_DOMAIN_ID": str(domain)})
        await stack.enter_async_context(robot)
        headset = await stack.enter_async_context(await Headset.connect("127.0.0.1", gateway.port))
        while (await headset.online()).ros_agent_ids != [7]:
            await asyncio.sleep(0.02)
        commands = await headset.advertise("/cmd_vel", "geometry_msgs/Twist", agents=[7])
        site = Site(endpoint, headset, commands, driven)
        await site.until(lambda status: len(status["nodes"]) == 2)
        while driven.empty():  # until the robot's publisher and our subscription have found each other
            await site.drive(0.1)
            await asyncio.sleep(0.05)
        await site.drive(0.5)
        while (await get(driven)).linear.x != 0.5:
            pass
        yield site


async def test_ls_shows_what_a_robot_does_and_offers(site: Site) -> None:
    """Control with its holder and times, dead-man, registrants and offers, in plain, in full and for programs."""
    me = f"unity/{site.headset.id}"
    status = await site.until(lambda status: status["nodes"][1]["control"]["holder"])
    stop, node = status["nodes"]
    assert (stop["role"], stop["name"]) == ("emergency stop", "/emergency_stop")
    assert (node["role"], node["name"], node["type"]) == ("publisher", "/cmd_vel", "geometry_msgs/msg/Twist")
    assert node["registrants"] == [me]
    assert node["control"]["holder"] == me
    assert 0 <= node["control"]["seconds_held"] < 30
    assert 30 < node["control"]["seconds_left"] <= 60
    assert node["deadman"] == {"silence_s": 60, "commander": me, "trips": 0, "last": ""}

    offers = (await site.robot("-v"))["offers"]
    assert offers["publishers"] == {"/chatter": "std_msgs/msg/String"}
    assert offers["subscribers"] == {"/cmd_vel": "geometry_msgs/msg/Twist"}

    _, plain, _ = await ended("ls", "-e", site.endpoint)
    assert plain.splitlines()[1].endswith(f"/cmd_vel: {me}")
    _, full, _ = await ended("ls", "-v", "-e", site.endpoint)
    robot = [line.split() for line in full.partition("robot 7\n")[2].splitlines()]
    assert ["ROS", "node", "/rosagent"] in robot
    assert ["emergency", "stop", "off"] in robot
    assert ["publisher", "/cmd_vel", "geometry_msgs/msg/Twist", me] in robot
    assert ["control", "/cmd_vel", me] in [line[:3] for line in robot]
    assert ["dead-man", "/cmd_vel", me, "trips:", "none"] in robot
    assert ["publishes", "/chatter", "std_msgs/msg/String", "reliable,", "volatile"] in robot


async def test_stop_holds_until_it_is_released(site: Site) -> None:
    """Who may stop stops it, in the state that everybody sees; commands are refused until who may release does."""
    code, out, _ = await ended("stop", "-e", site.endpoint, "--timeout", "5")
    assert (code, out) == (1, "robot 7 is NOT stopped: operator/0 may not stop this robot\n")

    (stopped,) = await macs("stop", "--as", "operator/5", "--json", "--timeout", "30", "-e", site.endpoint)
    assert stopped == {"id": 7, "done": True, "stopped": True, "by": "operator/5", "problem": ""}
    assert (await get(site.driven)).linear.z == -1.0
    await site.drive(0.6)
    status = await site.until(lambda status: status["drops"].get("stopped"))
    assert (status["stopped"], status["stop"]["by"], status["stop"]["times"]) == (True, "operator/5", 1)
    assert status["nodes"][1]["deadman"]["last"] == "emergency stop by operator/5"
    assert site.driven.empty()
    _, full, _ = await ended("ls", "-v", "-e", site.endpoint)
    assert "stopped by operator/5" in full.splitlines()[1]
    assert "emergency stop  by operator/5, " in full
    assert ["stopped", "1"] in [line.split() for line in full.splitlines()]

    code, out, _ = await ended(
        "stop", "--group", "3", "--release", "--as", f"unity/{site.headset.id}", "-e", site.endpoint
    )
    assert code == 1
    assert "may not release" in out
    code, out, _ = await ended("stop", "7", "--release", "--as", "operator/5", "--timeout", "30", "-e", site.endpoint)
    assert (code, out) == (0, "robot 7 is released\n")
    await site.drive(0.7)
    assert (await get(site.driven)).linear.x == 0.7


async def test_a_misspelled_topic_is_told(site: Site) -> None:
    """Who listens where nobody publishes, or drives what nobody hears, learns what may have been meant."""
    code, _, log = await ended("headset", site.headset.target, "sub", "/chater", "std_msgs/String", "--timeout", "4")
    assert code == 1
    assert "robot 7 offers no publisher of /chater; did you mean /chatter?" in log
    code, _, log = await ended(
        "headset", site.headset.target, "pub", "/cmdvel", "geometry_msgs/Twist", "{}", "--settle", "3"
    )
    assert code == 1
    assert "robot 7 offers no subscriber to /cmdvel; did you mean /cmd_vel?" in log


async def test_nothing_is_told_of_topics_that_are_there(site: Site) -> None:
    """A topic on which nothing happens is not a wrong one."""
    _, _, log = await ended("headset", site.headset.target, "sub", "/chatter", "std_msgs/String", "--timeout", "3")
    assert "offers no" not in log
    _, _, log = await ended(
        "headset", site.headset.target, "pub", "/cmd_vel", "geometry_msgs/Twist", "{}", "--settle", "3"
    )
    assert "offers no" not in log


async def test_an_agent_in_an_empty_domain_says_so(domain: int) -> None:
    """A robot that offers nothing is most often in another domain than its nodes: `ls -v` and `sub` say which."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with (
        Program("router", "-l", endpoint),
        Program("gateway", "--port", "0", "-e", endpoint) as gateway,
        Program("agent", "--id", "7", "-e", endpoint, env={"ROS_DOMAIN_ID": str(domain)}),
    ):
        _, shown, _ = await ended("ls", "-v", "-e", endpoint)
        assert f"ROS domain      {domain}\n" in shown
        assert f"nothing: the ROS graph of domain {domain} is empty" in shown
        sub = ("sub", "/chatter", "std_msgs/String", "--agents", "7", "--timeout", "4")
        code, _, log = await ended("headset", f"127.0.0.1:{gateway.port}", *sub)
        assert code == 1
        assert "robot 7 offers nothing at all; is its ROS_DOMAIN_ID that of its nodes?" in log
