"""docs/headset.md: its commands and its program run as they stand there, with a real gateway, robot and ROS."""

from __future__ import annotations

import asyncio
import os
import re
import shlex
import sys
from pathlib import Path

from std_msgs.msg import String
from std_srvs.srv import SetBool

from tests.support.programs import ROOT, Program, free_port, macs
from tests.support.ros_peer import Peer, say_hello, set_bool
from tests.support.waiting import get

PAGE = (ROOT / "docs" / "headset.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


async def test_the_page(domain: int, peer: Peer, tmp_path: Path) -> None:
    """Every command ends well, and the program prints what the page says."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    agent = Program("agent", "--id", "1", "-e", endpoint, env={"ROS_DOMAIN_ID": str(domain)})
    chatter = await peer.publisher(String, "/chatter")
    talk = await peer.subscription(String, "/talk")
    await peer.session.run(lambda: peer.session.node.create_service(SetBool, "/set", set_bool))
    talking = asyncio.create_task(say_hello(peer, chatter))
    (program,), (printed,) = blocks("python"), blocks("text")
    try:
        async with (
            Program("router", "-l", endpoint),
            agent,
            Program("gateway", "--port", "0", "-e", endpoint) as gateway,
        ):
            desk = tmp_path / "desk.py"
            desk.write_text(program.replace("7000", str(gateway.port)))
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                str(desk),
                stdout=asyncio.subprocess.PIPE,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
                cwd=tmp_path,
            )
            out, _ = await asyncio.wait_for(process.communicate(), 60)
            assert out.decode() == printed
            assert (await get(talk)).data == "hello"
            commands = re.findall("^macs headset .*", PAGE, re.MULTILINE)
            assert len(commands) == 4
            for command in commands:
                await macs(*shlex.split(command.replace("7000", str(gateway.port)))[1:])
            assert (await get(talk)).data == "hello"
    finally:
        talking.cancel()
