"""Programs that start while the first of their routers is away."""

from __future__ import annotations

import asyncio

from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from tests.integration.conftest import until
from tests.programs import free_port


async def test_the_next_router_is_tried_at_the_start(router: str) -> None:
    """A program whose first router does not run joins over its second one."""
    away = f"tcp/127.0.0.1:{free_port()}"
    async with await asyncio.wait_for(Mesh.open(MeshSettings(connect=[away, router])), 10) as mesh:
        await until(lambda: mesh.linked)


async def test_waiting_goes_on_until_any_router_is_there() -> None:
    """With none of several routers running a program says once what it waits for, and takes the first that comes."""
    first, second = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    waits: list[str] = []
    waiting = asyncio.Event()

    def on_waiting(target: str) -> None:
        waits.append(target)
        waiting.set()

    opening = asyncio.create_task(Mesh.open(MeshSettings(connect=[first, second]), on_waiting=on_waiting))
    await asyncio.wait_for(waiting.wait(), 10)
    async with await Mesh.open(MeshSettings(mode="router", listen=[second])), await asyncio.wait_for(opening, 10):
        assert waits == [f"{first}, {second}"]
