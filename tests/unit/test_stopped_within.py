"""`bridge.cli.running.until_stopped` with ``within_s``: a program that hangs at its end is ended."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import pytest

PROGRAM = """
import asyncio, ctypes, sys, time
from bridge.cli import running
from macs_zenoh.mesh.leaving import leave

async def work():
    print("ready", flush=True)
    try:
        await asyncio.Event().wait()
    finally:
        {hang}
    return 0

running.OVERDUE_S = 0.2
sys.exit(running.until_stopped(work, within_s={within_s}))
"""
KEEPS_PYTHON_WAITING = "ctypes.PyDLL(None).sleep(600)"
"""As a library does that waits and does not let other threads have their turn."""

LEAVES_FOR_EVER = "await leave(lambda: time.sleep(600))"


def started(hang: str, within_s: float) -> subprocess.Popen[str]:
    program = PROGRAM.format(hang=hang, within_s=within_s)
    process = subprocess.Popen([sys.executable, "-c", program], stdout=-1, stderr=-1, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize("hang", [KEEPS_PYTHON_WAITING, LEAVES_FOR_EVER])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
def test_what_hangs_is_ended(hang: str, number: signal.Signals) -> None:
    """It says where it hung."""
    with started(hang, 0.3) as process:
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "until_stopped" in errors


def test_what_ends_is_left_alone() -> None:
    """Its exit code is its own."""
    with started("pass", 60.0) as process:
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, "")


def test_another_signal_ends_what_is_overdue() -> None:
    """One that comes with the first does not."""
    with started(LEAVES_FOR_EVER, 600.0) as process:
        deadline = time.monotonic() + 60
        while process.poll() is None and time.monotonic() < deadline:
            process.send_signal(signal.SIGTERM)
            time.sleep(0.05)
        process.kill()
    assert process.returncode == -signal.SIGTERM
