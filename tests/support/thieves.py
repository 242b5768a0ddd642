"""A session whose Zenoh id somebody else takes while its link is lost."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from macs_zenoh import locked_out
from macs_zenoh.config import MeshSettings
from macs_zenoh.mesh import Mesh
from tests.support.links import Link
from tests.support.waiting import until

STAYS_MS = 120_000
"""A thief whom a busy machine keeps from the processor is not taken for one that has gone, which lets the owner in."""


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
    settings = MeshSettings(connect=[router], overrides=[f'id:"{zenoh_id(mesh)}"'], lease_ms=STAYS_MS)
    async with await Mesh.open(settings):
        link.mend()
        yield
