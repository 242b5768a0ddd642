"""A gateway as a process, what it takes of memory, and whether it still answers."""

from __future__ import annotations

import os
import resource
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from bridge.gateway import Gateway
from bridge.headset.client import Headset
from bridge.headset.stream import Way
from tests.support.programs import Program, free_port
from tests.support.waiting import PATIENCE_S


def memory_bytes(pid: int) -> int:
    """Resident memory of a process."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize()


def cpu_s(pid: int) -> float:
    """Processor time that a process has taken."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@asynccontextmanager
async def site(*options: str) -> AsyncIterator[tuple[str, Program]]:
    """A router and a gateway as processes."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with (
        Program("router", "-l", endpoint),
        Program("gateway", "--port", "0", "-e", endpoint, *options) as gateway,
    ):
        yield endpoint, gateway


def way_in(gateway: Gateway, port: str, authority: str) -> tuple[int, Way]:
    """How its port for ``plain``, ``tls`` or ``web``, without TLS, is reached; whose certificate is to be trusted."""
    if port == "tls":
        return gateway.listeners.tls_port, Way(tls=True, authority=authority)
    if port == "web":
        return gateway.listeners.web_port, Way(websocket=True)
    return gateway.listeners.port, Way()


async def answers(headset: Headset, timeout_s: float = PATIENCE_S) -> None:
    """The gateway still answers this headset."""
    assert headset.id in (await headset.online(timeout_s)).unity_agent_ids
