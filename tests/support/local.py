"""Zenoh in the process of the test: a router, and settings of sessions on it, that wait for whoever is slow.

A link whose other end takes nothing for half a second is closed by default, and what was under way is lost: right for
people who drive robots, wrong where a machine is busy and a test sends megabytes.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from tests.support.programs import free_port
from tests.support.routers import Router, as_macs_router

PATIENT_MS = 30_000


def patient(*endpoints: str) -> MeshSettings:
    """How to reach these routers."""
    return MeshSettings(connect=list(endpoints), block_limit_ms=PATIENT_MS)


@asynccontextmanager
async def local_router() -> AsyncIterator[str]:
    """A router; its endpoint."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with await Mesh.open(MeshSettings(mode="router", listen=[endpoint], block_limit_ms=PATIENT_MS)):
        yield endpoint


@asynccontextmanager
async def router_apart() -> AsyncIterator[str]:
    """A router in a process of its own; its endpoint."""
    async with Router(overrides=as_macs_router(MeshSettings(block_limit_ms=PATIENT_MS))) as router:
        yield router.endpoint
