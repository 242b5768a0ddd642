"""A robot whose log nobody takes, as in a terminal that was stopped with Ctrl-S, stops all the same."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from tests.ros.driven import STOPPED, Heard, hear, may_command, send, site
from tests.support.processes import ROOT, START_S
from tests.support.ros_peer import Peer
from tests.support.waiting import until

SETTINGS = "\n".join(
    f"""
[[robot.rules]]
match = "{topic}"
deadman_s = 0.5
deadman_message = {{ linear = {{ z = -1 }} }}
"""
    for topic in ("/base", "/arm")
)
NUMBER = 1


def fill(descriptor: int) -> None:
    """Write to a pipe until it takes no byte more."""
    os.set_blocking(descriptor, False)
    for size in (4096, 1):
        with suppress(BlockingIOError):
            while True:
                os.write(descriptor, b"." * size)
    os.set_blocking(descriptor, True)


@asynccontextmanager
async def robot(*argv: str, stderr: int, domain: int) -> AsyncIterator[None]:
    """`macs agent`, ready, with its log to a descriptor."""
    command = [sys.executable, "-m", "bridge", "agent", "--id", str(NUMBER), *argv]
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    process = await asyncio.create_subprocess_exec(
        *command, cwd=ROOT, env=environment, stdout=asyncio.subprocess.PIPE, stderr=stderr
    )
    try:
        assert process.stdout is not None
        assert await asyncio.wait_for(process.stdout.readline(), START_S) == f"ready: robot {NUMBER}\n".encode()
        yield
    finally:
        process.kill()
        await process.wait()


async def test_stops_reach_every_topic(domain: int, peer: Peer, tmp_path: Path) -> None:
    """With a full pipe instead of its log the dead-man stops base and arm, and so does who asks for a stop, who is
    answered."""
    reads, writes = os.pipe()
    try:
        async with site(domain, tmp_path, SETTINGS) as here, here.headset() as driver:
            common = ("-e", here.router.endpoint, "--settings", str(here.settings))
            async with robot(*common, stderr=writes, domain=domain):
                heard = {topic: await hear(peer, topic) for topic in ("/base", "/arm")}
                for topic in heard:
                    await may_command(driver, NUMBER, topic)
                fill(writes)
                for topic, said in heard.items():

                    def moves(topic: str = topic, said: Heard = said) -> bool:
                        send(driver, NUMBER, 0.5, topic)
                        return 0.5 in said.since(0)

                    await until(moves, every_s=0.1)  # ROS may know the publisher before its subscriber
                for said in heard.values():
                    await until(lambda said=said: said.last == STOPPED)
                for said in heard.values():
                    said.values.clear()
                assert await driver.call("ros", NUMBER, "stop", b"true")
                for said in heard.values():
                    await until(lambda said=said: said.last == STOPPED)
    finally:
        os.close(reads)
        os.close(writes)
