"""A session that routers do not let in any more, while they let in others: somebody else has its Zenoh id.

Zenoh tries on under the same id for ever. Whoever knows the id and may open a session can take it while the owner's
link is lost, and would keep the owner out for as long as he likes. A new session has a new id. Asyncio.
"""

from __future__ import annotations

import asyncio
import logging
import uuid
from contextlib import suppress

from .config import MeshSettings
from .errors import MacsError
from .mesh import Mesh
from .sections import changed

log = logging.getLogger("macs.mesh")

REFUSED_TIMES = 3
PATIENCE_S = 3.0
"""Beside a lease, in which a router may take a link that is gone for one that is there."""
AGAIN_S = 1.0
TRY_S = 2.0


def apart(settings: MeshSettings) -> MeshSettings:
    """The settings of a second session beside one with these: routers let nobody in who has another's Zenoh id."""
    others = [override for override in settings.overrides if not override.lstrip().startswith("id:")]
    if len(others) == len(settings.overrides) and settings.config_file is None:
        return settings  # Zenoh chooses the id
    return changed(settings, overrides=[*others, f'id:"a{uuid.uuid4().hex[1:]}"'])


async def locked_out(mesh: Mesh, *, any_id: bool = False) -> None:
    """Return when this session has been without a router for some time, and a second one, in its place, was let in
    three times meanwhile. Never where the id is in the settings, since another one is not wanted then; ``any_id``: it
    is, this program has made it up (`apart`)."""
    if mesh.settings.mode != "client" or (mesh.id_is_chosen and not any_id):
        await asyncio.Event().wait()
    while True:
        await asyncio.sleep(AGAIN_S)
        if not mesh.linked and await _stays_out(mesh):
            log.error("routers let others in and not this session: somebody has its Zenoh id; taking another one")
            return


async def _stays_out(mesh: Mesh) -> bool:
    await asyncio.sleep(PATIENCE_S + mesh.settings.lease_ms / 1000)
    refused = 0
    while not mesh.linked and refused < REFUSED_TIMES:
        refused += await _lets_another_in(mesh.settings)
        await asyncio.sleep(AGAIN_S)
    return not mesh.linked


async def _lets_another_in(settings: MeshSettings) -> bool:
    with suppress(MacsError):
        async with await Mesh.open_once(apart(settings), timeout_s=TRY_S):
            return True
    return False
