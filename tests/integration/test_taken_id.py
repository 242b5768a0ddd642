"""Somebody has taken the Zenoh id of a gateway: it goes on under another one. Of a robot: ros/test_locked_out.py."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

import bridge.gateway
from bridge.cli import gateway as verb
from bridge.headset.client import Headset
from bridge.settings import GatewaySettings, Settings
from macs_zenoh import locked_out
from macs_zenoh.config import MeshSettings
from macs_zenoh.locked_out import apart
from macs_zenoh.mesh import Mesh
from tests.support.links import counted
from tests.support.routers import Router
from tests.support.thieves import notice_soon, stolen, zenoh_id
from tests.support.waiting import PATIENCE_S, until


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    notice_soon(monkeypatch)


async def test_a_gateway_goes_on_under_another_id(monkeypatch: pytest.MonkeyPatch) -> None:
    """As long as the thief stays: on the same port, so that its headsets, which come back, reach each other again."""
    made: list[Any] = []

    class Noted(bridge.gateway.Gateway):
        def __init__(self, *args: Any) -> None:
            super().__init__(*args)
            made.append(self)

    monkeypatch.setattr(bridge.gateway, "Gateway", Noted)
    async with Router() as router, counted(router.endpoint) as link:
        settings = Settings(mesh=MeshSettings(connect=[link.endpoint]), gateway=GatewaySettings(port=0))
        running = asyncio.create_task(verb._serve(settings, None))
        await until(lambda: made and made[0].port)
        port, before = made[0].port, zenoh_id(made[0].mesh)
        headset = await Headset.connect("127.0.0.1", port, reconnect=True)
        async with stolen(made[0].mesh, link, router.endpoint):
            await until(lambda: len(made) == 2 and made[1].port)
            assert made[1].port == port
            assert zenoh_id(made[1].mesh) != before
            await until(lambda: headset.connected and made[1].agents)
            async with await Headset.connect("127.0.0.1", port) as other:
                await headset.send(b"still here", to=2, ids=[other.id], manager="Hi")
                assert (await asyncio.wait_for(other.receive(), PATIENCE_S)).data == b"still here"
        await headset.close()
        running.cancel()
        await asyncio.wait([running])


@pytest.mark.parametrize("where", ["overrides", "file"])
async def test_an_id_that_was_chosen_is_kept(tmp_path: Path, where: str) -> None:
    """Whether the settings name it or Zenoh's own file does: its owner wants no other, so nobody looks for one."""
    file = tmp_path / "zenoh.json5"
    file.write_text('{id: "abc123"}')
    chosen: dict[str, Any] = {"config_file": str(file)} if where == "file" else {"overrides": ['id:"abc123"']}
    async with Router() as router, counted(router.endpoint) as link:
        settings = MeshSettings(connect=[link.endpoint], **chosen)
        async with await Mesh.open(settings) as mesh:
            assert mesh.id_is_chosen
            assert mesh.zid == zenoh_id(mesh) == "abc123"
            noticed = asyncio.create_task(locked_out.locked_out(mesh))
            ours = asyncio.create_task(locked_out.locked_out(mesh, any_id=True))
            async with stolen(mesh, link, router.endpoint):
                await asyncio.wait_for(ours, PATIENCE_S)  # who made the id up himself wants another one
                assert not noticed.done()
            noticed.cancel()


async def test_an_id_that_zenoh_makes_up_is_not_chosen(tmp_path: Path) -> None:
    """Also beside a file of Zenoh's that says other things; and no second session has the first one's."""
    file = tmp_path / "zenoh.json5"
    file.write_text("{scouting: {delay: 1}}")
    async with Router() as router:
        settings = MeshSettings(connect=[router.endpoint], config_file=str(file))
        async with await Mesh.open(settings) as mesh, await Mesh.open(apart(settings)) as other:
            assert not mesh.id_is_chosen
            assert mesh.zid != zenoh_id(mesh)
            assert zenoh_id(mesh) != zenoh_id(other)
