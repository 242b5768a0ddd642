"""Programs that start while the first of their routers is away."""

from __future__ import annotations

import asyncio
import threading

import pytest
import zenoh

from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from tests.support.programs import free_port
from tests.support.waiting import PATIENCE_S, until


async def test_the_next_router_is_tried_at_the_start(router: str) -> None:
    """A program whose first router does not run joins over its second one."""
    away = f"tcp/127.0.0.1:{free_port()}"
    async with await asyncio.wait_for(Mesh.open(MeshSettings(connect=[away, router])), PATIENCE_S) as mesh:
        await until(lambda: mesh.linked)


@pytest.mark.parametrize("once", [False, True], ids=["open", "open_once"])
async def test_a_session_that_comes_late_is_closed(router: str, once: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who stops waiting for a session leaves none behind when it comes about after all."""
    sessions: list[zenoh.Session] = []
    began, go_on, there = threading.Event(), threading.Event(), threading.Event()
    really_open = zenoh.open

    def slow(config: zenoh.Config) -> zenoh.Session:
        began.set()
        go_on.wait(10)
        sessions.append(really_open(config))
        there.set()
        return sessions[0]

    monkeypatch.setattr(zenoh, "open", slow)
    settings = MeshSettings(connect=[router])
    opening = asyncio.ensure_future(Mesh.open_once(settings, timeout_s=PATIENCE_S) if once else Mesh.open(settings))
    await asyncio.to_thread(began.wait, 10)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    go_on.set()
    await asyncio.to_thread(there.wait, 10)
    await until(sessions[0].is_closed)


async def test_waiting_goes_on_until_any_router_is_there() -> None:
    """With none of several routers running a program says once what it waits for, and takes the first that comes."""
    first, second = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    waits: list[str] = []
    waiting = asyncio.Event()

    def on_waiting(target: str) -> None:
        waits.append(target)
        waiting.set()

    opening = asyncio.create_task(Mesh.open(MeshSettings(connect=[first, second]), on_waiting=on_waiting))
    await asyncio.wait_for(waiting.wait(), PATIENCE_S)
    async with (
        await Mesh.open(MeshSettings(mode="router", listen=[second])),
        await asyncio.wait_for(opening, PATIENCE_S),
    ):
        assert waits == [f"{first}, {second}"]
