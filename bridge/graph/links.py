"""The routers of a mesh, asked what they tell of themselves, and how long the way to each is."""

from __future__ import annotations

import asyncio
import time
from contextlib import suppress

from macs_zenoh.errors import MacsError
from macs_zenoh.mesh import Mesh
from macs_zenoh.protocol import keyexpr
from macs_zenoh.protocol.routers import Router, Trips, router_of

TIMED = 16
"""So many routers are timed at one look."""
ANSWER_S = 2.0


class Routers:
    """The routers of a mesh, asked by one session. ``mesh`` must have no namespace to see any but those that it is
    linked with: what routers tell is in none."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self.trips = Trips()

    async def look(self) -> list[Router]:
        """All that let themselves be seen, or at least those that we are linked with, each timed."""
        told: dict[str, Router] = {}
        if not self._mesh.settings.namespace:
            with suppress(MacsError):
                for _, answer in await self._mesh.ask_all(keyexpr.ROUTERS, timeout_s=ANSWER_S):
                    if (router := router_of(answer)) is not None:
                        told[router.zid] = router
        self.trips.keep(told)
        for zid in sorted(told)[:TIMED]:  # one after the other: they would wait for each other
            await self._time(zid)
        found = {zid: Router(zid) for zid in self._mesh.routers} | told
        return sorted(found.values(), key=lambda router: router.zid)

    async def _time(self, zid: str) -> None:
        began = time.perf_counter()
        with suppress(MacsError, asyncio.TimeoutError):
            if await self._mesh.ask_all(keyexpr.router_figures(zid), timeout_s=ANSWER_S):
                self.trips.note(zid, time.perf_counter() - began)
