"""Programs around ROS where ROS finds no place for its log: one line that says what to set, and with it they run."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

import pytest

from tests.support.programs import ROOT, Program, free_port
from tests.support.waiting import PATIENCE_S

PROGRAMS = {
    "agent": ["-m", "bridge", "agent", "--id", "3", "-e"],
    "awareness": ["-m", "bridge", "awareness", "--name", "a", "-e"],
    "demo": ["-m", "bridge.ros.demo"],
}


async def run(*words: str, **env: str) -> tuple[int | None, str]:
    kept = {name: value for name, value in os.environ.items() if name not in ("HOME", "ROS_LOG_DIR", "ROS_HOME")}
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, *words), cwd=ROOT, env={**kept, **env}, stderr=asyncio.subprocess.PIPE
    )
    _, errors = await asyncio.wait_for(process.communicate(), PATIENCE_S)
    return process.returncode, errors.decode()


@pytest.mark.parametrize("program", PROGRAMS)
async def test_without_a_home_the_log_directory_is_asked_for(program: str, domain: int) -> None:
    """No HOME, and one that cannot be written: exit code 1 and ROS_LOG_DIR, without a traceback."""
    words = PROGRAMS[program]
    where = [f"tcp/127.0.0.1:{free_port()}"] if words[-1] == "-e" else []
    for home in ({}, {"HOME": "/proc/1/nobody"}):
        code, errors = await run(*words, *where, ROS_DOMAIN_ID=str(domain), **home)
        assert code == 1
        assert "Traceback" not in errors
        assert "ROS_LOG_DIR" in errors.splitlines()[-1], errors
        assert ("HOME is not set" if not home else "/proc/1/nobody/.ros/log") in errors.splitlines()[-1]


async def test_with_a_log_directory_no_home_is_needed(domain: int, tmp_path: Path) -> None:
    """What the line says helps."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    env = {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(tmp_path), "HOME": ""}
    async with Program("router", "-l", endpoint), Program("agent", "--id", "3", "-e", endpoint, env=env) as robot:
        assert robot.ready == "robot 3"
