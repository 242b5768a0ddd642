"""Each verb for watching and acting on a secured mesh: with a certificate that may, and with ones that may not."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest
from geometry_msgs.msg import Twist
from std_msgs.msg import String
from std_srvs.srv import SetBool

from tests.support.programs import Program, ended
from tests.support.ros_peer import Peer, say_hello, set_bool
from tests.support.secured import made
from tests.support.waiting import until

CLIENTS = """
robots:
  - {name: robot-7, id: 7, group: 3}
gateways:
  - {name: hall-1, blocks: [1]}
operators:
  - {name: anna, id: 5}
  - {name: eve, id: 6}
permissions:
  - {who: hall-1, may: [command, see, call], whom: robots}
  - {who: anna, may: [command, see, call], whom: robots}
"""
"""Anna may everything, Eve nothing but look who is there."""

SEEN = {
    "topic list": ("topic", "list"),
    "topic info": ("topic", "info", "/chatter", "-v"),
    "service list": ("service", "list"),
    "action list": ("action", "list"),
    "echo": ("topic", "echo", "/chatter", "--once"),
    "hz": ("topic", "hz", "/chatter", "--count", "5"),
    "bw": ("topic", "bw", "/chatter", "--count", "5"),
    "pub": ("topic", "pub", "/cmd_vel", "linear: {x: 0.1}", "--once"),
    "call": ("service", "call", "/set", "data: true"),
    "bench": ("bench", "--robot", "7", "--seconds", "0.5"),
    "trace": ("trace", "/chatter", "--count", "3", "--seconds", "30"),
    "ping": ("ping", "7", "--count", "1"),
}
"""What concerns the robot."""
MESH = {
    "top": ("top", "--json"),
    "watch": ("watch", "--json", "--timeout", "0.5"),
}
"""What every operator may, since it is about who is there."""


@dataclass
class Site:
    """A secured mesh with robot 7, and whose certificates there are."""

    directory: Path

    async def macs(self, name: str, *argv: str, wait_s: float = 5.0) -> tuple[int, str, str]:
        """A verb with somebody's settings: its exit code, output and log."""
        words = ("--settings", str(self.directory / name / "macs.toml"), "--wait", str(wait_s))
        return await ended(*argv, *words)


@pytest.fixture
async def site(domain: int, peer: Peer, tmp_path: Path) -> AsyncIterator[Site]:
    found = made(tmp_path / "pki", CLIENTS)
    await peer.subscription(Twist, "/cmd_vel")
    await peer.session.run(lambda: peer.session.node.create_service(SetBool, "/set", set_bool))
    talking = asyncio.create_task(say_hello(peer, await peer.publisher(String, "/chatter")))
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(Program("router", "-c", str(found.file())))
        robot = ("agent", "--settings", str(found.directory / "robot-7" / "macs.toml"))
        await stack.enter_async_context(Program(*robot, env={"ROS_DOMAIN_ID": str(domain)}))
        site = Site(found.directory)

        async def offered() -> bool:
            _, out, _ = await site.macs("anna", "topic", "list")
            return {"/chatter", "/cmd_vel"} <= set(out.split())

        await until(offered, every_s=0.2)
        yield site
    talking.cancel()


def one_line(log: str) -> str:
    """What went wrong, which one line says; else there is only what happened, which a thread of Zenoh's tells."""
    assert "Traceback" not in log
    (said,) = [line for line in log.strip().splitlines() if line.startswith("macs ")]
    return said


async def test_who_may_does_all_of_it(site: Site) -> None:
    """With the certificate of an operator who may command, see and call, each verb does what it does elsewhere."""
    said = {}
    for name, argv in {**SEEN, **MESH}.items():  # one after the other: she is one operator
        code, said[name], log = await site.macs("anna", *argv, wait_s=30)
        assert code == 0, (name, said[name], log)
    assert "hello" in said["echo"]
    assert "success: true" in said["call"]
    assert "end to end" in said["trace"]
    assert [robot["id"] for robot in json.loads(said["top"])["robots"]] == [7]


async def test_who_may_not_is_told_so_in_a_line(site: Site) -> None:
    """With one that may only look who is there, what concerns the robot fails with a line; the mesh is seen."""
    for name, argv in SEEN.items():
        code, out, log = await site.macs("eve", *argv, wait_s=2)
        print(name, code, log.strip().splitlines()[-1:])
        assert code == 1, (name, out, log)
        assert "access rules may not" in one_line(log)
    for name, argv in MESH.items():
        code, out, log = await site.macs("eve", *argv, wait_s=30)
        assert code == 0, (name, out, log)


async def test_a_foreign_certificate_opens_nothing(site: Site, tmp_path: Path) -> None:
    """Of another authority, each verb ends within its time with a line that says that the router lets nobody in."""
    other = made(tmp_path / "other", CLIENTS)
    mine = (site.directory / "anna" / "macs.toml").read_text()
    theirs = Path(other.directory / "anna" / "macs.toml")
    theirs.write_text(mine.replace(str(site.directory / "anna"), str(other.directory / "anna")))
    verbs = {**SEEN, **MESH}
    foreign = Site(other.directory)
    ends = await asyncio.gather(*(foreign.macs("anna", *argv, wait_s=2) for argv in verbs.values()))
    for name, (code, out, log) in zip(verbs, ends, strict=True):
        print(name, code, log.strip().splitlines()[-1:])
        assert code == 1, (name, out, log)
        one_line(log)
