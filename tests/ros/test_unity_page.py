"""Every `macs` command of docs/unity.md, run in its order on one machine with a robot's ROS 2."""

from __future__ import annotations

import asyncio
import re
import shlex
from contextlib import AsyncExitStack

from geometry_msgs.msg import Twist
from std_msgs.msg import String

from bridge.cli import build_parser
from bridge.settings import GatewaySettings
from macs_zenoh.config import MeshSettings
from tests.support.programs import ROOT, Program, free_port, macs
from tests.support.ros_peer import Peer
from tests.support.waiting import get

PAGE = (ROOT / "docs" / "unity.md").read_text(encoding="utf-8")

SERVING = {"router", "gateway", "agent"}
ELSEWHERE = {"macs interfaces build PATH --install"}
"""Takes a compiler and half a minute, and has tests of its own."""


def commands() -> list[str]:
    """The page's commands, each once, in order: lines of code blocks, and code in sentences that has arguments."""
    blocks = [line for block in re.findall(r"```\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines()]
    inline = re.findall(r"(?<!`)`(macs \w+ [^`]+)`", PAGE)
    return list(dict.fromkeys(line for line in [*blocks, *inline] if line.startswith("macs ")))


def test_the_page_has_commands() -> None:
    """They are found, and each is one that the command line takes."""
    assert len(commands()) >= 8
    for command in commands():
        build_parser().parse_args(shlex.split(command)[1:])


async def test_every_command_runs(domain: int, peer: Peer) -> None:
    """From the first line to the last, each program serves, or ends with exit code 0 and says what the page says."""
    addresses = {"7447": str(free_port()), "7000": str(free_port())}
    assert {str(MeshSettings().routers[0].rpartition(":")[2]), str(GatewaySettings().port)} == set(addresses)
    publisher = await peer.publisher(String, "/chatter")
    driven = await peer.subscription(Twist, "/cmd_vel")
    ran: dict[str, object] = {}
    async with AsyncExitStack() as stack:
        talking = asyncio.create_task(_talk(peer, publisher))
        stack.callback(talking.cancel)
        for command in commands():
            if command in ELSEWHERE:
                continue
            argv = _here(command, addresses)
            if argv[0] in SERVING:
                await stack.enter_async_context(_serving(argv, addresses, domain))
            else:
                ran[command] = await macs(*argv, *(["--json"] if argv[0] == "ls" else []))
        await get(driven)
    online = ran["macs headset MACHINE:7000 online"]
    assert online["ros"] == [1]
    received = ran["macs headset MACHINE:7000 sub /chatter std_msgs/String --count 1"]
    assert received["message"] == {"data": "hello"}
    listed = ran["macs ls -e tcp/MACHINE:7447"]
    assert [(agent["type"], agent["id"]) for agent in listed] == [("ros", 1)]


async def _talk(peer: Peer, publisher: object) -> None:
    while True:
        await peer.session.run(lambda: publisher.publish(String(data="hello")))
        await asyncio.sleep(0.05)


def _here(command: str, addresses: dict[str, str]) -> list[str]:
    """The command for this machine, on ports that are free."""
    text = command.replace("MACHINE", "127.0.0.1").replace("0.0.0.0", "127.0.0.1").replace("192.168.1.0", "127.0.0.0")
    for port, free in addresses.items():
        text = text.replace(port, free)
    return shlex.split(text)[1:]


def _serving(argv: list[str], addresses: dict[str, str], domain: int) -> Program:
    """A program that goes on, at the ports that the page means when it names none."""
    where = {
        "router": ["-l", f"tcp/127.0.0.1:{addresses['7447']}"],
        "gateway": ["--port", addresses["7000"], "-e", f"tcp/127.0.0.1:{addresses['7447']}"],
        "agent": [],
    }
    return Program(*argv, *where[argv[0]], env={"ROS_DOMAIN_ID": str(domain)})
