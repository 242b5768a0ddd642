"""A session whose Zenoh id somebody else takes while its link is lost."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from macs_zenoh import locked_out
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from tests.support.links import Link
from tests.support.waiting import until


def notice_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let whoever is locked out look for it after half a second."""
    monkeypatch.setattr(locked_out, "PATIENCE_S", 0.5)
    monkeypatch.setattr(locked_out, "AGAIN_S", 0.1)


def zenoh_id(mesh: Mesh) -> str:
    """The id under which Zenoh knows the session."""
    return str(mesh._session.zid())


@asynccontextmanager
async def stolen(mesh: Mesh, link: Link, router: str) -> AsyncIterator[None]:
    """A thief at the router has the session's id: it was there before the session's link came back."""
    link.cut()
    await until(lambda: not mesh.linked)
    settings = MeshSettings(connect=[router], overrides=[f'id:"{zenoh_id(mesh)}"'])
    async with await Mesh.open(settings) as thief:
        keeping = asyncio.create_task(_keep_out(mesh, thief, link))
        try:
            yield
        finally:
            keeping.cancel()


async def _keep_out(mesh: Mesh, thief: Mesh, link: Link) -> None:
    """A router that ends a lost session late ends with it the one that has its id by then (Zenoh 1.10.2,
    ``del_transport_unicast``). Both try again, and the owner may be first: then the thief comes once more."""
    while True:
        if mesh.linked:
            link.cut()
        if link.is_cut and thief.linked and not mesh.linked:
            link.mend()
        await asyncio.sleep(0.02)
