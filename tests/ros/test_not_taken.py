"""Who sends a robot what it does not take is told why, with an exit code: real programs, one robot, `macs headset`."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Twist

from bridge.headset.client import Headset
from macs_zenoh.protocol.messages import Functionality, FunctionalityRequest, decode_data
from tests.support.programs import Program, ended, free_port
from tests.support.ros_peer import Peer

SETTINGS = """
[robot]
id = 7
register_allow = ["group/3"]
groups = { 3 = ["unity"] }
stop_allow = ["unity"]
release_allow = ["unity"]

[[robot.rules]]
match = "/cmd_vel"
exclusive = true
hold_s = 60

[[robot.rules]]
match = "/only_read"
read_only = true
"""

TWIST = "geometry_msgs/Twist"


@dataclass
class Site:
    """Robot 7 behind a gateway."""

    endpoint: str
    gateway: str

    async def headset(self, *words: str, group: int = 3) -> tuple[int | None, list[dict[str, Any]], str]:
        code, out, log = await ended("headset", self.gateway, "--group", str(group), *words)
        return code, [json.loads(line) for line in out.splitlines()], log

    async def drive(self, *options: str, topic: str = "/cmd_vel", group: int = 3) -> tuple[int | None, str]:
        """Publish one command; the exit code, and why robot 7 did not take it, empty when it was published."""
        code, (line,), log = await self.headset(
            "pub", topic, TWIST, '{"linear": {"x": 0.5}}', "--agents", "7", *options, group=group
        )
        if "refused" not in line:
            assert line == {"topic": topic, "published": 1}, log
            return code, ""
        (refused,) = line["refused"]
        assert refused["robot"] == 7
        assert refused["reason"] in log or "not online" in log
        return code, str(refused["reason"])


@pytest.fixture
async def site(domain: int, peer: Peer, tmp_path: Path) -> AsyncIterator[Site]:
    settings = tmp_path / "macs.toml"
    settings.write_text(SETTINGS)
    await peer.subscription(Twist, "/cmd_vel")
    async with AsyncExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        await stack.enter_async_context(Program("router", "-l", endpoint))
        gateway = await stack.enter_async_context(Program("gateway", "--port", "0", "-e", endpoint))
        robot = Program("agent", "--settings", str(settings), "-e", endpoint, env={"ROS_DOMAIN_ID": str(domain)})
        await stack.enter_async_context(robot)
        async with await Headset.connect("127.0.0.1", gateway.port) as headset:
            while (await headset.online()).ros_agent_ids != [7]:
                await asyncio.sleep(0.02)
            while (
                "/cmd_vel"
                not in decode_data(Functionality, await headset.ask(7, FunctionalityRequest.manager)).subscribers
            ):
                await asyncio.sleep(0.02)
        yield Site(endpoint, f"127.0.0.1:{gateway.port}")


async def test_pub_says_why_a_command_is_not_taken(site: Site) -> None:
    """What is carried out is exit code 0; stopped, not in control, not allowed, read only, misspelled, offline: 1."""
    assert await site.drive() == (0, "")

    code, reason = await site.drive(group=4)
    assert (code, "may" in reason) == (1, True), reason
    code, reason = await site.drive(topic="/only_read")
    assert (code, "only read" in reason) == (1, True), reason
    code, reason = await site.drive(topic="/cmd_vle")
    assert (code, "did you mean /cmd_vel?" in reason) == (1, True), reason
    assert await site.drive(topic="/no_ros_node_takes_this") == (0, "")  # another headset may

    host, _, port = site.gateway.rpartition(":")
    async with await Headset.connect(host, int(port), group=3) as holder:
        commands = await holder.advertise("/cmd_vel", TWIST, agents=[7])
        taken = (0, "")
        while taken[0] == 0:  # until ours has come first
            await commands.publish(b"\0\1\0\0" + bytes(48))
            taken = await site.drive()
        assert taken == (1, f"unity/{holder.id} has control")

    assert (await ended("stop", "7", "-e", site.endpoint, "--as", "unity/9"))[0] == 0
    code, reason = await site.drive("--rate", "50", "--count", "20")
    assert (code, "stop" in reason) == (1, True), reason


async def test_verbs_say_that_a_robot_refuses_or_is_not_there(site: Site) -> None:
    """`sub`, `call` and `serve` end with 1 and the reason; offline robots and headsets are told at once."""
    code, lines, log = await site.headset("sub", "/cmd_vel", "std_msgs/String", "--agents", "7")
    assert (code, lines) == (1, []), log
    assert "/cmd_vel was refused by robot 7" in log
    code, lines, log = await site.headset("serve", "/ask", "std_srvs/SetBool", "--agents", "7", group=4)
    assert (code, lines) == (1, []), log
    code, lines, log = await site.headset("call", "/ask", "std_srvs/SetBool", "--agent", "7", group=4)
    assert (code, lines) == (1, []), log
    assert "may" in log.splitlines()[-1]

    code, lines, log = await site.headset("sub", "/t", "std_msgs/String", "--agents", "9", "--timeout", "1")
    assert (code, "robot 9 is not online" in log) == (1, True), log
    code, lines, log = await site.headset("call", "/ask", "std_srvs/SetBool", "--agent", "9")
    assert (code, "robot 9" in log, "not online" in log) == (1, True, True), log
    code, lines, log = await site.headset("pub", "/cmd_vel", TWIST, "{}", "--agents", "7,9")
    assert code == 1
    assert lines[0]["refused"] == [{"robot": 9, "reason": "it is not online"}]
    code, lines, log = await site.headset("send", "hello", "--to", "ros", "--ids", "7,9")
    assert (code, lines[0]["absent"]) == (1, [9])
