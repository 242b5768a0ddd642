"""`macs up --demo`: what a newcomer runs first, as a whole."""

from __future__ import annotations

import asyncio
import os
import sys

from tests.programs import ROOT


async def test_the_demo_shows_a_headset_that_sees_and_drives_a_robot(domain: int) -> None:
    """With one command and no hardware, a headset gets pictures and poses of a robot and moves it."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "bridge", "up", "--demo", "--once", "--port", "0", "--router-port", "0"),
        cwd=ROOT,
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    out, log = await asyncio.wait_for(process.communicate(), 60)
    shown = out.decode()
    assert process.returncode == 0, shown + log.decode()
    for step in ("connected", "who is here", "camera", "pose", "drive"):
        assert f"\n  {step} " in shown
    assert "FAILED" not in shown
