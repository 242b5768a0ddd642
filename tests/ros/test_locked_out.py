"""Somebody takes a session's Zenoh id while its link is lost: the program goes on under another one."""

from __future__ import annotations

import asyncio
import json

import pytest

from bridge.ros import program
from bridge.settings import RobotSettings, Settings
from macs_zenoh import join, locked_out
from macs_zenoh.agent import Agent
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from tests.support.links import counted
from tests.support.routers import Router
from tests.support.thieves import notice_soon, stolen, zenoh_id
from tests.support.waiting import PATIENCE_S, until


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    notice_soon(monkeypatch)


async def test_who_is_locked_out_notices_and_who_is_cut_off_is_not() -> None:
    """A link that is lost, and comes back, is none; the same with a thief is."""
    async with (
        Router() as router,
        counted(router.endpoint) as link,
        await Mesh.open(MeshSettings(connect=[link.endpoint])) as mesh,
    ):
        noticed = asyncio.create_task(locked_out.locked_out(mesh))
        link.cut()
        await until(lambda: not mesh.linked)
        await asyncio.sleep(0.5)
        link.mend()
        await until(lambda: mesh.linked)
        await asyncio.sleep(0.5)
        assert not noticed.done()
        async with stolen(mesh, link, router.endpoint):
            await asyncio.wait_for(noticed, PATIENCE_S)
            assert not mesh.linked


async def test_a_robot_goes_on_under_another_id(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as the thief stays: the robot is online again, with another session, and answers; stopped, as it was."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    came: list[Agent] = []
    stop = asyncio.Event()
    async with Router() as router, counted(router.endpoint) as link:
        settings = Settings(mesh=MeshSettings(connect=[link.endpoint]), robot=RobotSettings(id=7))
        async with join("operator", id=5, settings=MeshSettings(connect=[router.endpoint])) as operator:
            running = asyncio.create_task(program.run(settings, on_ready=came.append, stop=stop))
            await until(lambda: came)
            before = zenoh_id(came[0].mesh)
            await operator.call("ros", 7, "stop", b"true")
            async with stolen(came[0].mesh, link, router.endpoint):
                await until(lambda: len(came) == 2)
                assert zenoh_id(came[1].mesh) != before
                status = json.loads(await operator.call("ros", 7, "status"))
                assert status["stopped"] is True, status
            stop.set()
            await asyncio.wait_for(running, PATIENCE_S)
