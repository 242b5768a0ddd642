"""Some minutes of chaos; `python -m tests.attack.chaos --minutes 60` is the long run."""

from __future__ import annotations

import os

import pytest

pytest.importorskip("rclpy", reason="the robot that runs in it needs ROS")

from tests.attack.chaos import run

MINUTES = float(os.environ.get("MACS_CHAOS_MINUTES", "5"))
SEED = int(os.environ.get("MACS_CHAOS_SEED", "12"))


@pytest.mark.chaos
@pytest.mark.timeout(60 * MINUTES + 240)
async def test_everything_comes_back_by_itself() -> None:
    """Whatever is killed, stopped, cut off or flooded: ids stay unique, presence true, registrations as wanted, and
    nothing is left over."""
    print(await run(MINUTES, SEED))
