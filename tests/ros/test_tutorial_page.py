"""docs/tutorial.md: its commands, from the demo robot to the released stop, as they stand there."""

from __future__ import annotations

import asyncio
import os
import re
import shlex
import sys
from contextlib import AsyncExitStack
from typing import Any

from bridge.cli import build_parser
from tests.support.programs import ROOT, Program, ended, free_port

PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
SERVING = {"router", "gateway", "agent"}


def commands(language: str) -> list[str]:
    """The lines of the page's blocks in one language."""
    blocks = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    return [line.removeprefix("$ ") for block in blocks for line in block.splitlines()]


def test_the_last_steps_are_commands() -> None:
    """What is typed on one's own robot is taken by the command line."""
    assert len(commands("console")) == 2
    for command in commands("console"):
        build_parser().parse_args(shlex.split(command)[1:])


async def test_the_first_steps_work(domain: int) -> None:
    """The demo robot is seen, drives, answers, stops and is released."""
    ports = {"7447": str(free_port()), "7000": str(free_port())}
    env = {"ROS_DOMAIN_ID": str(domain)}
    done: dict[str, str] = {}
    async with AsyncExitStack() as stack:
        for command in commands("sh"):
            argv = shlex.split(command)
            if argv[0] == "python":
                await stack.enter_async_context(_DemoRobot(argv[1:], env))
                continue
            here = [re.sub("7000", ports["7000"], word) for word in argv[1:]]
            if here[0] in SERVING:
                await stack.enter_async_context(Program(*here, *_on(here[0], ports), env=env))
                continue
            end = ["-e", f"tcp/127.0.0.1:{ports['7447']}"] if here[0] in ("ls", "stop") else []
            code, out, errors = await ended(*here, *end)
            assert code == 0, (command, errors)
            done[command] = out
    _judge(done)


def _on(verb: str, ports: dict[str, str]) -> list[str]:
    """The options that put a program on this test's ports instead of the usual ones."""
    router = f"tcp/127.0.0.1:{ports['7447']}"
    return {"router": ["-l", router], "gateway": ["--port", ports["7000"], "-e", router]}.get(verb, ["-e", router])


def _judge(done: dict[str, str]) -> None:
    """The outputs say what the page says of them."""
    before, after = (out.splitlines() for command, out in done.items() if "/pose" in command)
    assert len(before) == 3
    assert before[0] != after[0]
    assert "stopped" in done["macs ls"].lower()  # the second one, after the stop
    (lights,) = (out for command, out in done.items() if "/set_lights" in command)
    assert '"success": true' in lights


class _DemoRobot:
    """The ROS 2 node of the first step, ended with the block."""

    def __init__(self, argv: list[str], env: dict[str, str]) -> None:
        self._argv, self._env = argv, {**os.environ, **env}
        self._process: asyncio.subprocess.Process

    async def __aenter__(self) -> _DemoRobot:
        self._process = await asyncio.create_subprocess_exec(
            sys.executable, *self._argv, cwd=ROOT, env=self._env, stdout=asyncio.subprocess.DEVNULL
        )
        return self

    async def __aexit__(self, *_: Any) -> None:
        self._process.terminate()
        await self._process.wait()
