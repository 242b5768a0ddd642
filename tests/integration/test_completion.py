"""Completion as a shell asks for it: words, and what the mesh has."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys

import pytest

import macs_zenoh
from tests.support.processes import finished
from tests.support.programs import ended


async def offered(line: str, **environment: str) -> list[str]:
    """What Tab offers behind a line."""
    asked = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "COMP_LINE": line, "COMP_POINT": str(len(line))}
    command = f"{sys.executable} -m bridge 8>&1 9>/dev/null 1>/dev/null"
    _, out, errors = await finished("bash", "-c", command, env={**environment, **asked})
    assert errors == ""
    return [word.strip() for word in out.split("\n") if word.strip()]


async def test_words_are_completed() -> None:
    """Verbs, what they take, their options and files."""
    assert await offered("macs sec") == ["security"]
    assert await offered("macs completion ") == ["bash", "zsh", "fish"]
    assert "--release" in await offered("macs stop --re")
    assert "goal" in await offered("macs headset 127.0.0.1 g")
    assert "pyproject.toml" in await offered("macs ls --settings pyproj")


async def test_robots_and_topics_are_asked_from_the_mesh(router: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ids of robots that are online, their topics and services; who names the router: -e, or MACS_CONNECT."""
    offers = {
        "publishers": {"/chatter": "std_msgs/msg/String"},
        "subscribers": {"/cmd_vel": "geometry_msgs/msg/Twist"},
        "services": {"/set": "std_srvs/srv/SetBool"},
    }
    monkeypatch.setattr("os.environ", {**os.environ, "MACS_CONNECT": router})
    async with (
        macs_zenoh.join("ros", id=7, connect=[router]) as robot,
        macs_zenoh.join("ros", id=12, connect=[router]),
    ):

        async def answer(call: macs_zenoh.Call) -> bytes:
            return json.dumps(offers).encode()

        robot.serve("offers", answer)
        await robot.call("ros", 7, "offers")

        async def until_offered(line: str, words: list[str], **environment: str) -> None:
            """On a busy machine a second may be too short for one that starts."""
            for _ in range(10):
                if (seen := await offered(line, **environment)) == words:
                    return
            assert seen == words

        await until_offered(f"macs stop -e {router} ", ["7", "12"], MACS_CONNECT="")
        await until_offered("macs stop 1", ["12"])
        await until_offered("macs headset 127.0.0.1 sub /x --agents 7,", ["7,12"])
        await until_offered("macs headset 127.0.0.1 sub /", ["/chatter"])
        await until_offered("macs headset 127.0.0.1 pub /", ["/cmd_vel"])
        await until_offered("macs headset 127.0.0.1 call /", ["/set"])
        await until_offered("macs topic echo /", ["/chatter"])
        await until_offered("macs topic pub /", ["/cmd_vel"])
        await until_offered("macs service call /", ["/set"])
        await until_offered("macs topic hz /x --robot 7,", ["7,12"])
        await until_offered("macs ping 1", ["12"])


async def test_without_a_mesh_nothing_is_offered() -> None:
    """Nobody is told why."""
    assert await offered("macs stop ", MACS_CONNECT="tcp/127.0.0.1:1") == []
    assert await offered("macs stop ", MACS_CONNECT="nonsense") == []


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
async def test_each_shell_can_read_what_is_printed(shell: str) -> None:
    """`macs completion SHELL` is a script of that shell that names `macs`."""
    code, out, _ = await ended("completion", shell)
    assert code == 0
    assert "macs" in out
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell} here")
    read = subprocess.run([shell, "-n"], input=out, capture_output=True, text=True, check=False)
    assert (read.returncode, read.stderr) == (0, "")
